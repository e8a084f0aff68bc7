"""The example of docs/identification.md runs and says what the page says it says."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[3] / "docs" / "identification.md"


def test_the_pages_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    scope: dict[str, object] = {}
    exec(example, scope)
    said = capsys.readouterr().out
    assert "'gain[elbow]': " in said
    assert "gain[shoulder]" in said
    assert "gain[shoulder] changes no reading, since gravity does not act on it in these poses" in said
