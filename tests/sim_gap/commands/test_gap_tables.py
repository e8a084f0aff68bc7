"""Tables of a diagnosis in the terminal: each row has its own effect, joint and numbers."""

from types import SimpleNamespace

from armlink.commands.plain_console import results
from sim_gap.commands.gap_diagnose import show
from sim_gap.search.estimate import Value


def cause(effect: str, joints: tuple[str, ...], name: str) -> SimpleNamespace:
    values = {joint: {name: Value(float(k), 0.0, 9.0, "N·m")} for k, joint in enumerate(joints, start=1)}
    numbers = {"gap_before": 2.0, "gap_after": 0.5, "confidence": 0.9}
    return SimpleNamespace(effect=effect, joints=joints, parameters=values, confounded_with=(), **numbers)


def test_every_parameter_stands_beside_its_effect_and_joint(capsys) -> None:
    causes = cause("friction.coulomb", ("j1", "j2"), "torque"), cause("torque.offset", ("j2",), "offset")
    gaps = {"noise_floor": (0.01, 0.02), "heldout_before": (1.0, 2.0), "heldout_after": (0.1, 0.2)}
    answer = SimpleNamespace(causes=causes, names=("j1", "j2"), heldout_is="the end", unit="N·m", notes=(), **gaps)
    show(answer, results())
    lines = [line.replace("│", " ").split() for line in capsys.readouterr().out.splitlines()]
    rows = [line for line in lines if line[:1] in (["friction.coulomb"], ["torque.offset"], ["j1"], ["j2"])]
    assert [row[:4] for row in rows] == [
        ["friction.coulomb", "all", "2", "2"],
        ["torque.offset", "j2", "2", "0.5"],
        ["friction.coulomb", "j1", "torque", "1"],
        ["friction.coulomb", "j2", "torque", "2"],
        ["torque.offset", "j2", "offset", "1"],
        ["j1", "0.01", "1", "0.1"],
        ["j2", "0.02", "2", "0.2"],
    ]
