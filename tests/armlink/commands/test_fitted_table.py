"""Tables at every width: each name comes whole where a line can hold it, and nothing is cut."""

import io

from hypothesis import given, settings
from hypothesis import strategies as st
from rich.box import SIMPLE
from rich.table import Column, Table

from armlink.commands.plain_console import PlainConsole

NAMES = st.lists(
    st.sampled_from(
        ["j2s6s200_joint_1", "j2s6s200_joint_2", "panda_joint4", "left/elbow", "friction.coulomb", "1.93 ± 0.02", ""]
    ),
    min_size=2,
    max_size=7,
)


def shown(table: Table, width: int) -> list[str]:
    console = PlainConsole()
    console.file, console.width = io.StringIO(), width
    console.print(table)
    return console.file.getvalue().splitlines()


@settings(deadline=None, max_examples=60, derandomize=True)
@given(st.lists(NAMES, min_size=1, max_size=4), st.integers(20, 200), st.booleans(), st.booleans())
def test_every_word_comes_whole(rows, width, no_wrap, light):
    columns = max(map(len, rows))
    headings = ["joint", *(f"heading {number} [N·m]" for number in range(1, columns))]
    table = Table(Column(headings[0], no_wrap=no_wrap), *headings[1:], title="their parameters", box=SIMPLE)
    if not light:
        table = Table(Column(headings[0], no_wrap=no_wrap), *headings[1:], title="their parameters")
    for row in rows:
        table.add_row(*row, *[""] * (columns - len(row)))
    lines = shown(table, width)
    assert max(map(len, lines)) <= width
    words = " ".join(lines).split()
    for word in (word for row in rows for cell in row for word in cell.split()):
        assert word in words, lines
    assert "…" not in "".join(lines)


def test_a_wide_terminal_has_the_table_and_a_narrow_one_a_list():
    table = Table("effect", "joint", "torque [N·m]")
    for number in (1, 2):
        table.add_row("friction.coulomb", f"j2s6s200_joint_{number}", "1.93")
    assert len(shown(table, 80)) == 6
    assert [line.split() for line in shown(table, 40)] == [
        ["effect", "friction.coulomb"],
        ["joint", "j2s6s200_joint_1"],
        ["torque", "[N·m]", "1.93"],
        [],
        ["effect", "friction.coulomb"],
        ["joint", "j2s6s200_joint_2"],
        ["torque", "[N·m]", "1.93"],
    ]
    assert "  j2s6s200_joint_1" in [line.rstrip() for line in shown(table, 20)]


def test_a_table_whose_rows_have_names_is_cut_between_columns_before_its_cells_wrap():
    table = Table("joint", "gain", "true gain", "offset [N·m]", title="Sensors")
    for number in (1, 2):
        table.add_row(f"panda_joint{number}", f"0.98 ± 0.0{number}", "0.99", f"1.93 ± 0.0{number}")
    lines = [" ".join(line.split()) for line in shown(table, 46)]
    assert [line for line in lines if "panda_joint1" in line] == [
        "│ panda_joint1 │ 0.98 ± 0.01 │ 0.99 │",
        "│ panda_joint1 │ 1.93 ± 0.01 │",
    ]
    assert sum("Sensors" in line for line in lines) == 1


def test_a_long_title_is_a_line_above_and_not_folded_into_the_table():
    table = Table("joint", title="Model against sensor at 24 poses [N·m]")
    table.add_row("j1")
    assert shown(table, 60)[0].rstrip() == "Model against sensor at 24 poses [N·m]"


def test_a_table_whose_first_column_is_empty_is_not_cut_into_parts_without_names():
    table = Table("", "record", "note")
    table.add_row("", "59dc5835", "after the sweeps of spring")
    assert next(line.split() for line in shown(table, 20)) == ["record", "59dc5835"]
