"""Commands against the joints that follow them: the option of the refusal settles it."""

from dataclasses import replace

import pytest
from servo_arm import JOINTS, model_text, record

from armlink.errors import BadInput
from armlink.recording.corrections import AS_IT_IS, parse_corrections
from armlink.recording.recording import Recording
from sim_gap.checks.position_command import check_position_only
from sim_gap.model.load import load_model


@pytest.fixture(scope="module")
def servo() -> Recording:
    return record(model_text(kp=60.0, friction=0.1), 3, 14.0)


def check(recording, stated=AS_IT_IS):
    from mujoco import MjModel

    arm = load_model(MjModel.from_xml_string(model_text(kp=60.0, friction=0.1)), JOINTS, 2).arm
    return check_position_only(arm, [recording], ["r.csv"], stated)


@pytest.mark.parametrize(
    ("holds", "option"),
    [([1, 0], "--map q_cmd_2=q_cmd_1,q_cmd_1=q_cmd_2"), ([0, 0], "--map q_cmd_2=q_cmd_2")],
)
def test_the_option_settles_whose_command_it_is(servo, holds, option):
    spoiled = replace(servo, position_command=servo.position_command[:, holds])
    with pytest.raises(BadInput, match="is followed by q_") as refused:
        check(spoiled)
    if holds == [1, 0]:
        assert option in str(refused.value)
    else:
        assert "elbow: q_cmd_2 is followed by q_1" in str(refused.value)
        assert "--map q_cmd_2=COLUMN, or =q_cmd_2 if it is right" in str(refused.value)
    stated = parse_corrections(columns=[option.removeprefix("--map ")])
    assert check(stated.apply(spoiled, "r.csv"), stated)[1] == []
