"""`armlink check --scales` for machines: its schema is the documented one."""

from pathlib import Path

from armlink.commands.check import SCALES_SCHEMA as SCHEMA


def test_the_schema_is_documented():
    assert isinstance(SCHEMA, str)
    assert f"`{SCHEMA}`" in (Path(__file__).parents[3] / "docs" / "formats.md").read_text(encoding="utf-8")
