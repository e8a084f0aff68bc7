"""The nominal model, as it is: what every other tool has to improve on."""

from referee.interface import Answer, Case


def solve(case: Case) -> Answer:
    return Answer("mujoco", model=case.model.read_text(encoding="utf-8"))
