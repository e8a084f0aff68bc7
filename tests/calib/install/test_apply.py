"""`--apply` of a record from sweeps: what is refused before anything is opened, and what the gates admit is written."""

from types import SimpleNamespace

import numpy as np
import pytest

from armlink.errors import BadInput, Refused
from calib.install import apply
from calib.install.apply import Apply, apply_record

ARM = SimpleNamespace(joint_names=("joint_1", "joint_2"))


def record(*offsets: float | None) -> SimpleNamespace:
    made = SimpleNamespace(joints=[SimpleNamespace(offset=offset) for offset in offsets])
    made.require = lambda arm: made
    return made


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[tuple]:
    """What the gate admits, and the gravity model of the check motion."""
    calls: list[tuple] = []

    def write(gate, record, arm, store, beta, how, reason):
        calls.append((gate(None), beta))
        return ("joint_1",)

    monkeypatch.setattr(apply, "admit_fitted", lambda *given: "admitted")
    monkeypatch.setattr(apply, "_write", write)
    return calls


def test_what_the_gates_admit_is_written_and_kept_in_any_case(written: list[tuple]) -> None:
    kept: list[object] = []
    store = SimpleNamespace(add=kept.append)
    some = record(0.1, None)
    beta = np.array([1.0, 2.0])
    assert apply_record(some, ARM, store, Apply("me"), beta, "sweeps") == ("joint_1",)
    assert written == [("admitted", beta)]
    assert kept == [some]


def test_a_record_without_anything_to_write_is_kept_and_refused(written: list[tuple]) -> None:
    kept: list[object] = []
    nothing = record(None, None)
    with pytest.raises(Refused, match="nothing is written"):
        apply_record(nothing, ARM, SimpleNamespace(add=kept.append), Apply("me"), None, "sweeps")
    assert kept == [nothing]
    assert written == []


def test_joints_that_the_arm_has_not_are_named(written: list[tuple]) -> None:
    with pytest.raises(BadInput, match="--replaced elbow: there is no such joint"):
        apply_record(record(0.1), ARM, None, Apply("me", replaced=("elbow",)), None, "sweeps")
    assert written == []
