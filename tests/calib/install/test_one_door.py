"""Every write of a calibration goes through `calib.install.journaled_write`: nothing else reaches a controller."""

import ast
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from fake_controllers import ARM, NAMES, Controllers, joint, record

from armlink.errors import BusFault, Refused
from armlink.link.types import Calibration
from calib.install.journaled_write import install, recover
from calib.install.plausibility import GateRefused, Refusal, admit, admit_rollback
from calib.observer.decision import DriftFinding
from calib.observer.recalibrator import Checked, Recalibrator
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore

ROOT = Path(__file__).parents[3]
PACKAGES = ("armlink", "calib", "gcomp", "sim_bus", "sim_gap")
DOOR, GATES = "calib/install/journaled_write.py", "calib/install/plausibility.py"
ASKS = "armlink/loop/cycle_process.py"
"""Where the process that makes the cycles is asked for anything."""
FORWARDER = (ASKS, "")
"""The attribute by which it is asked to write."""
LINKS = ("armlink/loop/kept_arm.py", "armlink/loop/remote_link.py")
"""That of a daemon, and that of a command."""
WIRE = "armlink/drives/canopen/torque_sensor_record.py"
DRIVES = "armlink/drives/canopen/drives.py"
OBJECTS = ("STAGED_GAIN", "STAGED_OFFSET", "ACTIVATE")
"""Of 2100h, without which no calibration becomes active."""


ASKED_FOR = re.compile(rf"\b(write_calibration|write_record|Call|_call|_enabled|remote|Admitted|{'|'.join(OBJECTS)})\b")
"""Names that the tests look for; a file without one says nothing to them."""


@cache
def nodes() -> list[tuple[str, str, ast.AST]]:
    """(File, function, node) of the whole source, each file from the top; of files that use a name of these tests."""
    found: list[tuple[str, str, ast.AST]] = []

    def visit(node: ast.AST, path: str, function: str) -> None:
        for child in ast.iter_child_nodes(node):
            found.append((path, function, child))
            visit(child, path, child.name if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) else function)

    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if ASKED_FOR.search(text):
                visit(ast.parse(text), path.relative_to(ROOT).as_posix(), "")
    return found


def names_in(node: ast.AST) -> list[object]:
    """Names that a node itself uses: of a variable, an attribute, an import, or spelt out as a string."""
    if isinstance(node, ast.Attribute):
        return [node.attr]
    if isinstance(node, ast.Name):
        return [node.id]
    if isinstance(node, ast.alias):
        return [node.name, node.asname]
    return [node.value] if isinstance(node, ast.Constant) else []


@cache
def uses() -> dict[object, list[tuple[str, str, type[ast.AST]]]]:
    """Name → (file, function, kind of node) of every use of it; its definitions are none."""
    found: dict[object, list[tuple[str, str, type[ast.AST]]]] = {}
    for path, function, node in nodes():
        for name in names_in(node):
            found.setdefault(name, []).append((path, function, type(node)))
    return found


def users(name: str) -> set[tuple[str, str]]:
    return {(path, function) for path, function, _ in uses()[name]}


def calls(*names: str) -> Iterator[tuple[str, str, ast.expr | None]]:
    """(File, function, first argument) of every call of a function or method of these names."""
    for path, function, node in nodes():
        if isinstance(node, ast.Call) and set(names) & set(names_in(node.func)):
            yield path, function, node.args[0] if node.args else None


# ---- by the source


def test_only_the_door_calls_write_calibration() -> None:
    """Beside it there are only forwarders: methods of that name, and the one through the bus process."""
    callers = users("write_calibration")
    assert {function for path, function in callers if path == DOOR} == {"_write", "_restore"}
    others = {(path, function) for path, function in callers if path != DOOR and function != "write_calibration"}
    assert others == {FORWARDER}


def test_only_a_forwarder_asks_the_bus_process_to_write() -> None:
    """By the protocol's own method; functions in a `Call` (`RemoteLink.inside`) are subject to the test above."""
    asked = [(path, function, ast.unparse(what)) for path, function, what in calls("remote") if what is not None]
    written = [(path, function) for path, function, what in asked if what.endswith(".write_calibration")]
    assert written == [FORWARDER]
    assert not [kind for *_, kind in uses()["write_calibration"] if kind is ast.Constant]  # nor by a name in quotes


def test_a_call_of_the_bus_process_spells_its_name_out() -> None:
    """Otherwise a name put together at run time would pass the test above."""
    assert {(path, function) for path, function, _ in calls("Call")} == {(ASKS, "_call")}
    requests = [call for call in calls("_call", "_enabled") if call[0] in (ASKS, *LINKS)]
    assert {what.value for _, _, what in requests if isinstance(what, ast.Constant)} >= {"start", "enable"}
    passed_on = {(path, function) for path, function, what in requests if not isinstance(what, ast.Constant)}
    assert passed_on == {(LINKS[1], "inside"), (LINKS[1], "_enabled"), (ASKS, "ask")}
    methods = [what for *_, what in calls("remote")]
    assert methods
    assert all(isinstance(what, ast.Attribute) for what in methods)  # of a protocol, by its name


NAMED = ("armlink/drives/canopen/check/guard_rules.py", "_record_writes")
"""Names the objects for the guard of the bus, with the bounds of their values; sends nothing."""


def test_only_write_calibration_uses_the_wire_format() -> None:
    assert users("write_record") == {(DRIVES, "write_calibration")}
    for name in OBJECTS:
        used = {use for use in users(name) if not use[0].endswith("object_dictionary.py")}
        assert used - {NAMED} == {(WIRE, "write_record")}


def test_only_the_gates_admit_a_record() -> None:
    admitted = {path for path, _, _ in calls("Admitted")}
    assert admitted == {GATES}


# ---- as it runs


class Guarded(Controllers):
    """Refuses a write for which the journal has no open line."""

    def __init__(self, store: RecordStore) -> None:
        super().__init__()
        self.store, self.writes = store, 0

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        line = self.store.unfinished_write(ARM)
        assert line is not None, "written without a journal line"
        assert joint in [entry["joint"] for entry in line.body["before"]]
        assert line.body["gates"]
        self.writes += 1
        return super().write_calibration(joint, calibration, store)


FINDING = DriftFinding(1, "drift", 1.03, 0.3, np.diag([4e-8, 1e-5]), 40, 0.999)


def _install(store: RecordStore, controllers: Controllers) -> None:
    new = record(joints=(joint("shoulder", 1.12), joint("elbow", 1.08)))
    install(admit(new, ARM, store), store, controllers, by="ann", reason="sweeps", check=None)


def _failed_check(store: RecordStore, controllers: Controllers) -> None:
    new = record(note="new")
    with pytest.raises(Refused, match="worse"):
        install(admit(new, ARM, store), store, controllers, by="ann", reason="sweeps", check=lambda: "worse")


def _recover(store: RecordStore, controllers: Controllers) -> None:
    entries = [{"joint": 0, "name": NAMES[0], "gain": 1.1, "offset": -0.4, "record_id": 0, "date": 0}]
    store.begin_write(record().id, ARM, "ann", entries, reason="sweeps", gates="bounds")
    assert recover(ARM, store, controllers) is not None


def _rollback(store: RecordStore, controllers: Controllers) -> None:
    held = dict(enumerate(controllers.held))
    admitted = admit_rollback(record(), ARM, store, held)
    install(admitted, store, controllers, by="ann", reason="rollback", check=None)


def _recalibrate(store: RecordStore, controllers: Controllers) -> None:
    Recalibrator(ARM, controllers, store).recalibrate(FINDING)


def _undo(store: RecordStore, controllers: Controllers) -> None:
    recalibrator = Recalibrator(ARM, controllers, store)
    recalibrator.recalibrate(FINDING)
    recalibrator.undo(Checked("worse", 1, "elbow: RMS 0.9 N·m"))


def _restore(store: RecordStore, controllers: Controllers) -> None:
    store.put(record(joints=(joint("shoulder", 1.12), joint("elbow"))), ARM, by="ann", reason="imported")
    Recalibrator(ARM, controllers, store).restore()


@pytest.mark.parametrize("way", [_install, _failed_check, _recover, _rollback, _recalibrate, _undo, _restore])
def test_each_way_writes_under_an_open_journal_line_and_ends_it(
    store: RecordStore, way: Callable[[RecordStore, Controllers], None]
) -> None:
    controllers = Guarded(store)
    way(store, controllers)
    assert controllers.writes
    assert store.unfinished_write(ARM) is None
    stages = [line.stage for line in store.writes(ARM)]
    assert stages[0::2] == ["begun"] * (len(stages) // 2)
    assert set(stages[1::2]) <= {"finished", "undone"}


def test_a_write_carries_the_record_s_number_and_date(store: RecordStore) -> None:
    controllers = Controllers()
    _restore(store, controllers)
    current = store.current(CalibrationRecord, ARM)
    assert current is not None
    assert {held.record_id for held in controllers.held} == {current.number}
    assert {held.date for held in controllers.held} == {int(current.created.timestamp())}


def test_a_controller_that_answers_with_something_else_than_was_written_gets_its_old_calibration_back(
    store: RecordStore,
) -> None:
    class Deaf(Controllers):
        def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
            return self.held[joint] if joint else super().write_calibration(joint, calibration, store)

    controllers = Deaf()
    with pytest.raises(BusFault, match=r"elbow: its drive holds gain 1\.1 and"):
        _install(store, controllers)
    assert controllers.held == Controllers().held
    assert store.writes(ARM)[-1].stage == "undone"


# ---- the gate of a roll-back


def far(store: RecordStore, new: CalibrationRecord, **held: Calibration) -> None:
    now = {j: held.get(name, Calibration(1.1, -0.4, 7)) for j, name in enumerate(NAMES)}
    admit_rollback(new, ARM, store, now)


def test_a_roll_back_asks_only_how_far_the_record_is_from_what_is_installed(store: RecordStore) -> None:
    """10 % of gain and of rated torque (50 N·m) pass; history and bounds are not asked for."""
    far(store, record(joints=(joint("shoulder", 1.2), joint("elbow", 1.1, 4.5))))
    for new, said in (
        (joint("elbow", 1.25), r"elbow: gain 1\.2500 is \+13\.6% away from what its drive holds"),
        (joint("elbow", 1.1, 6.0), r"elbow: offset 6\.000 N·m is \+6\.400 N·m away from what its drive holds"),
    ):
        with pytest.raises(GateRefused, match=said) as error:
            far(store, record(joints=(joint("shoulder"), new)))
        assert (error.value.refusal, error.value.joint) == (Refusal.FAR, "elbow")
        admit_rollback(
            record(joints=(joint("shoulder"), new)), ARM, store, {1: Calibration(1.1, -0.4, 7)}, replaced=["elbow"]
        )


def test_a_blank_controller_is_far_from_nothing(store: RecordStore) -> None:
    far(store, record(joints=(joint("shoulder"), joint("elbow", 1.4, 9.0))), elbow=Calibration(1.0, 0.0))


def test_the_calibration_before_the_last_write_is_never_far(store: RecordStore) -> None:
    """An exchanged sensor's new record is written, and taken back."""
    controllers = Controllers()
    jump = record(joints=(joint("shoulder"), joint("elbow", 1.4, 9.0)), note="exchanged")
    replaced = admit(jump, ARM, store, replaced=["elbow"])
    install(replaced, store, controllers, by="ann", reason="sweeps", check=None)
    with pytest.raises(GateRefused):
        admit_rollback(record(joints=(joint("shoulder"), joint("elbow", 1.15))), ARM, store, {1: controllers.held[1]})
    _rollback(store, controllers)
    assert controllers.held[1].gain == pytest.approx(1.1)
    assert store.writes(ARM)[-2].body["gates"].startswith("roll-back: only the distance")
