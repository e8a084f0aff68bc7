"""examples/yam.yaml with a model as a YAM's: upright its first torque constant cannot be seen, tilted it can."""

import shutil
from pathlib import Path

import pytest
import yaml

from armlink.arm_file import ArmFile, load_arm
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_motion
from calib.commissioning.model_checks import model_findings
from calib.plan.creep_plan import plan_creep
from calib.plan.rough_gravity import VERTICAL, is_vertical

EXAMPLE = Path(__file__).parents[3] / "examples" / "yam.yaml"
LINKS = (
    # axis, place in the parent [m], range [rad], mass [kg], centre of mass [m]
    ("0 0 1", "0 0 0.06", "-2.6 3.0", 0.15, "0 0 0.02"),
    ("0 1 0", "0 0 0.04", "0 3.6", 1.2, "-0.13 0 0"),
    ("0 -1 0", "-0.26 0 0", "0 3.6", 0.85, "0.12 0 0.05"),
    ("0 -1 0", "0.24 0 0.06", "-1.5 1.5", 0.46, "0.07 0 0.04"),
    ("0 0 1", "0.07 0 0.04", "-1.5 1.5", 0.35, "0 0 0.03"),
    ("1 0 0", "0.04 0 0", "-2.0 2.0", 0.6, "0.06 0 0.01"),
)
"""About as long and heavy as its maker's arm; made up."""
TILTED = "gravity: [3.354, 0.0, -9.215]"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The arm file with a model where it looks for the user's."""
    shutil.copy(EXAMPLE, tmp_path)
    body, inertia = "", "1e-3 1e-3 1e-3"
    for number, (axis, at, span, mass, centre) in reversed(list(enumerate(LINKS, start=1))):
        body = (
            f'<body name="link_{number}" pos="{at}"><inertial pos="{centre}" mass="{mass}" diaginertia="{inertia}"/>'
            f'<joint name="joint{number}" axis="{axis}" range="{span}"/>{body}</body>'
        )
    (tmp_path / "i2rt_yam").mkdir()
    text = f'<mujoco><compiler angle="radian"/><worldbody><body name="arm">{body}</body></worldbody></mujoco>'
    (tmp_path / "i2rt_yam" / "yam.xml").write_text(text)
    return tmp_path


def tilted(folder: Path) -> ArmFile:
    """With the line of the file's own comment."""
    text = (folder / "yam.yaml").read_text()
    assert f"# {TILTED}" in text
    (folder / "yam.yaml").write_text(text.replace(f"# {TILTED}", TILTED))
    return load_arm(folder / "yam.yaml")


def test_upright_the_first_joint_is_named_with_the_remedy(folder: Path) -> None:
    arm = load_arm(folder / "yam.yaml")
    assert sweep_motion(arm) == "creep"
    short = {**yaml.safe_load(arm.path.read_text()), "sweep": {"creep": {"span": 0.8}}}
    arm.path.write_text(yaml.safe_dump(short))
    plan = plan_creep(load_arm(arm.path))
    assert plan.notes == (f"joint1: {VERTICAL}",)
    assert {sweep.joint for sweep in plan.sweeps} == set(range(6))
    assert [each.where for each in model_findings(arm) if "vertical" in each.what] == ["joint1"]


def test_on_a_tilted_base_it_can_be_seen(folder: Path) -> None:
    arm = tilted(folder)
    assert not is_vertical(gcomp_arm(arm), 0)
    assert not [each for each in model_findings(arm) if "vertical" in each.what]
