"""The layout: imports without a circle. Layers are contracts in pyproject.toml."""

from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("armlink", "calib", "gcomp", "sim_bus", "sim_gap")


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """Every module of ours → the modules of ours that it imports, late imports and those for type checkers included."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def test_no_module_imports_itself_by_way_of_others(imports: dict[str, set[str]]) -> None:
    left = dict(imports)
    while free := [module for module, needed in left.items() if not needed & left.keys()]:
        for module in free:
            del left[module]
    while idle := left.keys() - set().union(*left.values(), set()):  # that circles import nothing of
        for module in idle:
            del left[module]
    assert left == {}, "modules in circles, and between circles"


def test_the_layers_of_a_package_name_all_its_folders() -> None:
    import tomllib

    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = {one["containers"][0]: " ".join(one["layers"]) for one in contracts if "containers" in one}
    for package in PACKAGES:
        folders = {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
        assert folders <= set(layers[package].replace("|", " ").split()), package


def test_pytest_takes_no_module_of_ours_for_tests(pytestconfig: pytest.Config) -> None:
    """One that it does is loaded by pytest, whoever imports it: the campaigns' mutants and probes do not get in."""
    patterns = pytestconfig.getini("python_files")
    modules = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    assert [path.name for path in modules if any(path.match(pattern) for pattern in patterns)] == []
