"""Run every benchmark, show a table, write benchmarks/latest.json. make bench runs it, with one thread each."""

import json
from importlib import import_module
from pathlib import Path

from rich.console import Console
from rich.table import Table
from side_by_side import measure

HERE = Path(__file__).parent
MODULES = sorted(path.stem for path in HERE.glob("bench_*.py"))


def main() -> None:
    """Measure every case of `bench_*.py` beside this file."""
    console = Console(stderr=True)
    results = []
    for module in MODULES:
        for case in import_module(module).cases():
            console.print(f"{case.name} …")
            results.append(measure(case))
    table = Table("benchmark", "ours", "peer", "unit", "ratio", "peer is")
    for each in results:
        figures = (f"{each['ours']:.3g}", f"{each['peer']:.3g}", each["unit"], f"{each['ratio']:.2f}")
        table.add_row(each["name"], *figures, each["peer_name"])
    console.print(table)
    (HERE / "latest.json").write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
