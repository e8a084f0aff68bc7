"""Text of YAML files: values through the dumper, comments on one line each.

Names come from models and drives, so no line is put together from them by hand.
"""

import io
import math
from collections.abc import Mapping
from typing import Any

import yaml
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.scalarstring import DoubleQuotedScalarString

from armlink.content.printable_text import printable_text

WIDTH = 160
"""Characters after which the dumper breaks lines in block style; a choice."""


class _Dumper(yaml.SafeDumper):
    """Flow style, text with anything that is not printable in double quotes and escaped."""

    def represent_text(self, text: str) -> yaml.Node:
        return self.represent_scalar("tag:yaml.org,2002:str", text, None if text.isprintable() else '"')

    def write_double_quoted(self, text: str, split: bool = True) -> None:
        self.allow_unicode = text.isprintable()
        super().write_double_quoted(text, split)
        self.allow_unicode = True


_Dumper.add_representer(str, _Dumper.represent_text)


def yaml_value(value: Any) -> str:
    """A value on one line, as a part of YAML in flow or block style."""
    text: str = yaml.dump(
        [value], Dumper=_Dumper, default_flow_style=True, width=math.inf, allow_unicode=True, sort_keys=False
    )
    return text.strip()[1:-1]


def yaml_entry(key: str, value: Any, indent: int = 0, note: str = "") -> str:
    """A line `key: value  # note`."""
    return " " * indent + f"{yaml_value(key)}: {yaml_value(value)}" + (note and yaml_comment(note, 2))


def yaml_item(value: Any, indent: int, note: str = "") -> str:
    """A line `- value  # note` of a list."""
    return " " * indent + f"- {yaml_value(value)}" + (note and yaml_comment(note, 2))


def yaml_comment(text: str, indent: int = 0) -> str:
    """A comment, on one line whatever is in the text."""
    return " " * indent + f"# {printable_text(text)}"


def yaml_document(content: Any) -> str:
    text: str = yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=WIDTH)
    return text


class EditedYaml:
    """A YAML text that is changed in places: comments, order and the rest of the text stay."""

    def __init__(self, text: str) -> None:
        self._yaml = YAML()
        self._yaml.preserve_quotes, self._yaml.width = True, 10_000
        self._yaml.indent(mapping=2, sequence=4, offset=2)
        self.content: Any = self._yaml.load(text)
        """Mappings and lists of the text, to be changed in place."""

    @staticmethod
    def scalar(value: Any) -> Any:
        """A value to be set: text in quotes where the dumper of this module would quote it."""
        return DoubleQuotedScalarString(value) if isinstance(value, str) and yaml_value(value) != value else value

    def in_line(self, values: Mapping[str, Any]) -> Any:
        """A mapping that is written on one line."""
        made = CommentedMap({key: self.scalar(value) for key, value in values.items()})
        made.fa.set_flow_style()
        return made

    @property
    def text(self) -> str:
        written = io.StringIO()
        self._yaml.dump(self.content, written)
        return written.getvalue()
