"""Whole files from outside that are small by their nature, and YAML: sizes are asked before anything is read."""

from pathlib import Path
from typing import Any

import yaml

from armlink.errors import BadInput

MOST_SMALL = 4 << 20
"""Size of an arm file, record, data sheet or description of a bag [bytes]; the covariance of a record of 64 joints has
192 by 192 numbers of some 22 characters, 0.8 MB, and data sheets of drives with all their profiles some hundreds of
kB."""
MOST_TEXT = 64 << 20
"""Size of a URDF, MJCF or JSON file, and of an OBJ or MSH mesh [bytes]: a hundred times that of published arms' files,
and more than the statistics of a LeRobot data set."""
MOST_NODES = 200_000
"""Values in a YAML file, each counted as often as aliases repeat it; the 4 MB above hold about as many."""


def read_whole(path: Path, most: int = MOST_SMALL) -> bytes:
    """The content of a file of at most `most` bytes; raises BadInput beyond that and for a device, OSError."""
    if path.exists() and not path.is_file():
        raise BadInput(f"{path} is a folder or a device: give a file")
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise BadInput(f"{path}: holds more than {most / 1e6:.0f} MB, expected less")
    return content


def parse_yaml(content: bytes | str, path: Path) -> Any:
    """The content of a YAML file; raises BadInput, in one line, where it is none or its aliases make it too large."""
    try:
        text = content.decode("utf-8") if isinstance(content, bytes) else content
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        if root is not None and "&" in text:  # an anchor, so aliases may be there
            _require_few_nodes(root, path)
        return None if root is None else yaml.SafeLoader("").construct_document(root)
    except RecursionError:
        raise BadInput(f"{path}: the YAML is nested too deeply") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # a date or number that does not exist, for example
        raise BadInput(f"{path}: not YAML: {' '.join(str(error).split())}") from None


def _require_few_nodes(root: yaml.Node, path: Path) -> None:
    """Raise BadInput where aliases stand for more values than MOST_NODES, or for what they are in themselves."""
    counts: dict[int, int] = {}
    kept = []  # the nodes, so that no id is given twice

    def count(node: yaml.Node) -> int:
        known = counts.get(id(node))
        if known == 0:
            raise BadInput(f"{path}: an alias refers to a part of the file that contains it")
        if known:
            return known
        counts[id(node)] = 0
        kept.append(node)
        parts: list[yaml.Node] = []
        if isinstance(node, yaml.SequenceNode):
            parts = node.value
        elif isinstance(node, yaml.MappingNode):
            parts = [each for pair in node.value for each in pair]
        counts[id(node)] = total = 1 + sum(map(count, parts))
        if total > MOST_NODES:
            raise BadInput(f"{path}: its aliases stand for more than {MOST_NODES} values")
        return total

    count(root)
