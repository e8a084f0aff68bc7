"""Models that no arm can have are named before anything moves, in the same words by every command."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from armlink.cli import run
from armlink.errors import BadInput
from calib.commissioning.chain import find_chains, model_joints
from calib.commissioning.doctor import examine
from calib.commissioning.draft import LOAD_FACTOR, draft_of_model
from calib.commissioning.model_checks import (
    gain_errors,
    gravity_need,
    model_errors,
    model_findings,
    refuse_impossible_model,
    refuse_impossible_sweep,
)
from calib.commissioning.new_arm import NewArm, new_arm
from gcomp.arm.load import ModelArm, load_model
from gcomp.gravity.torque import gravity_torque


@dataclass
class DrawnModel:
    """A URDF of a serial arm, as one of its size may be; its defects are put in by factors."""

    seed: int
    reach: float | None = None
    mass_factor: float = 1.0
    massless: bool = False
    effort: float | None = None
    """For every joint; None: two to six times what gravity needs."""
    effort_factor: float = 1.0

    def write(self, folder: Path) -> Path:
        path = folder / "drawn.urdf"
        path.write_text(self._text([1e9] * 9))
        need = gravity_need_of(path)
        random = np.random.default_rng([self.seed, 1])
        efforts = random.uniform(2.0, 6.0, len(need)) * np.maximum(need, 0.05 * need.max()) * self.effort_factor
        path.write_text(self._text(efforts if self.effort is None else [self.effort] * len(need)))
        return path

    def _text(self, efforts: "np.ndarray | list[float]") -> str:
        random = np.random.default_rng(self.seed)
        n = int(random.integers(2, 8))
        reach = float(np.exp(random.uniform(np.log(0.3), np.log(1.0)))) if self.reach is None else self.reach
        lengths = random.dirichlet(np.full(n, 2.0)) * reach
        density = float(np.exp(random.uniform(np.log(3.0), np.log(25.0))))
        masses = random.dirichlet(np.full(n, 2.0)) * density * (reach + 0.15) ** 3 * self.mass_factor
        links = ['<link name="base"/>']
        before = 0.0
        for i in range(n):
            size = max(lengths[i], 0.02)
            inertia = masses[i] * size**2 / 12
            inertial = f'<inertial><origin xyz="{size / 2} 0 0.01"/><mass value="{masses[i]}"/>'
            inertial += f'<inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial>'
            links.append(f'<link name="link_{i}">{"" if self.massless else inertial}</link>')
            parent, axis = ("base" if i == 0 else f"link_{i - 1}"), ("0 1 0" if i % 2 == 0 else "0 0 1")
            links.append(
                f'<joint name="joint_{i}" type="revolute"><parent link="{parent}"/><child link="link_{i}"/>'
                f'<origin xyz="{before} 0 0"/><axis xyz="{axis}"/>'
                f'<limit lower="-1.5" upper="1.6" effort="{efforts[i]}" velocity="1"/></joint>'
            )
            before = size
        return f'<robot name="drawn">{"".join(links)}</robot>'


def gravity_need_of(path: Path) -> np.ndarray:
    return gravity_need(load_model(path))


def drafted(model: Path, ratings: Mapping[str, float] | None = None) -> NewArm:
    """As `new` has it before it looks for collisions, which takes long; raises BadInput as it does."""
    joints, gravity = model_joints(model)
    chain = find_chains(joints, model)[0]
    made = NewArm(model.with_suffix(".yaml"), draft_of_model(model.stem, model, chain, gravity, {}, ratings))
    for found in model_errors(made.parsed()):
        raise BadInput(str(found))
    return made


@pytest.mark.sample(3)
@pytest.mark.parametrize("seed", range(12))
def test_an_arm_that_could_be_built_is_believed(seed: int, tmp_path: Path) -> None:
    made = drafted(DrawnModel(seed).write(tmp_path))
    assert not any("assumed (" in note for note in made.draft.notes)
    assert not list(model_errors(made.parsed()))


@pytest.mark.sample(3)
@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_masses_in_another_unit_are_named(seed: int, factor: float, tmp_path: Path) -> None:
    """Grams for kilograms, and the other way round: no arm of that size weighs so much, or so little."""
    with pytest.raises(BadInput, match=r"the moving links weigh .* kg at a reach of .* write masses in kg"):
        drafted(DrawnModel(seed, mass_factor=factor).write(tmp_path))


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(3))
def test_a_model_without_masses_has_nothing_to_calibrate(seed: int, tmp_path: Path) -> None:
    model = DrawnModel(seed, massless=True).write(tmp_path)
    with pytest.raises(BadInput, match="the model states no masses"):
        new_arm(model, tmp_path / "arm.yaml")


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", [3, 7])
def test_an_arm_whose_axes_are_all_vertical_has_nothing_to_calibrate_by(seed: int, tmp_path: Path) -> None:
    """Its file is written all the same: its base can be inclined."""
    model = DrawnModel(seed, effort=2.0).write(tmp_path)
    model.write_text(model.read_text().replace('axis xyz="0 1 0"', 'axis xyz="0 0 1"'))
    flat = drafted(model, {f"joint_{i}": 500.0 for i in range(9)}).parsed()
    with pytest.raises(BadInput, match=r"kinematics.gravity: gravity loads no joint in any pose"):
        refuse_impossible_model(flat)
    assert flat.kinematics is not None
    inclined = flat.kinematics.model_copy(update={"gravity": (6.9, 0.0, -6.9)})
    refuse_impossible_model(flat.model_copy(update={"kinematics": inclined}))


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(3))
def test_axes_that_meet_in_one_point_give_no_gains(seed: int, tmp_path: Path) -> None:
    """A finger, or a wrist without the arm: a mass farther out looks like a sensor that reads high."""
    model = DrawnModel(seed, mass_factor=0.1).write(tmp_path)
    assert not list(gain_errors(drafted(model).parsed()))
    model.write_text(re.sub('<origin xyz="[^"]*"/><axis', '<origin xyz="0 0 0"/><axis', model.read_text()))
    wrist = drafted(model, {f"joint_{i}": 500.0 for i in range(9)}).parsed()
    assert len(list(gain_errors(wrist))) == 1
    with pytest.raises(BadInput, match="axes of all joints that gravity loads pass through one point"):
        refuse_impossible_sweep(wrist, 0.0)


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("effort", [1.0, 10.0, 100.0, 1000.0])
def test_a_placeholder_for_every_joint_is_no_rating(seed: int, effort: float, tmp_path: Path) -> None:
    model = DrawnModel(seed, effort=effort).write(tmp_path)
    made = drafted(model)
    need = gravity_need_of(model)
    assert all("rated_torque assumed: 3 times the load" in joint.notes[0] for joint in made.draft.joints)
    assert [joint.rated_torque for joint in made.draft.joints] >= (0.9 * LOAD_FACTOR * need).tolist()
    assert any(f"effort limit of {effort:g} N·m for every joint is a placeholder" in note for note in made.draft.notes)
    assert not list(model_errors(made.parsed()))


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(6))
def test_limits_of_a_far_stronger_arm_are_no_ratings(seed: int, tmp_path: Path) -> None:
    made = drafted(DrawnModel(seed, effort_factor=30.0).write(tmp_path))
    assert any("are all more than 10 times the load" in note for note in made.draft.notes)


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(6))
def test_a_limit_below_the_load_is_replaced_where_it_stands(seed: int, tmp_path: Path) -> None:
    model = DrawnModel(seed).write(tmp_path)
    need = gravity_need_of(model)
    weak = int(np.argmax(need))
    text = model.read_text().replace(f'effort="{efforts_of(model)[weak]}"', f'effort="{need[weak] / 3}"')
    model.write_text(text)
    made = drafted(model)
    assumed = ["assumed: 3 times" in joint.notes[0] for joint in made.draft.joints]
    assert assumed == [joint == weak for joint in range(len(need))]
    ratings = {f"joint_{weak}": 5 * float(need[weak])}
    given = drafted(model, ratings).draft.joints[weak]
    assert given.rated_torque == given.max_torque == ratings[given.name]


def efforts_of(model: Path) -> list[str]:
    return [part.partition('"')[0] for part in model.read_text().split('effort="')[1:]]


def test_torques_that_the_protocol_cannot_carry_are_refused(tmp_path: Path) -> None:
    """2100h:01 is INTEGER32 in µN·m and ends at 2147 N·m."""
    with pytest.raises(BadInput, match=r"object 2100h can report at most 2147 N·m"):
        drafted(DrawnModel(3, reach=6.0).write(tmp_path))


def test_a_link_without_mass_is_mentioned(tmp_path: Path) -> None:
    model = DrawnModel(2).write(tmp_path)
    text = model.read_text()
    begin = text.index("<inertial>", text.index('name="link_1"'))
    end = text.index("</inertial>", begin) + len("</inertial>")
    model.write_text(text[:begin] + text[end:])
    made = drafted(model)
    warnings = [found.what for found in model_findings(made.parsed()) if found.level == "warning"]
    assert "the links moved by joint_1 have no mass in the model" in warnings


def test_every_command_refuses_in_the_words_of_doctor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An arm file that was sound when `new` wrote it, and whose model then lost its masses."""
    model = DrawnModel(1).write(tmp_path)
    made = drafted(model)
    made.write()
    model.write_text(DrawnModel(1, massless=True)._text([50.0] * 9))
    arm, out = str(made.out), str(tmp_path / "out")
    error = next(found for found in examine(arm, offline=True) if found.level == "error")
    (tmp_path / "poses.csv").write_text("q_1,q_2,q_3\n0,0,0\n")
    commands = [["sweep", arm, "--plan"], ["sweep", arm, "--dry-run", "--out", out], ["float", arm]]
    commands.append(["torque", arm, "--q", str(tmp_path / "poses.csv")])
    for words in [*commands, ["demo", "--arm", arm, "--out", out]]:
        assert run(words) == 2
        assert capsys.readouterr().err.strip() == f"armlink: {error}"
        assert not Path(out).exists()


def scaled_lengths(text: str, factor: float) -> str:
    return re.sub(
        r'xyz="([^"]+)"(?=/><mass|/><axis)',
        lambda found: f'xyz="{" ".join(str(factor * float(each)) for each in found[1].split())}"',
        text,
    )


DEFECTS: dict[str, tuple[Callable[[DrawnModel], None], Callable[[str], str], str]] = {
    "grams": (lambda drawn: setattr(drawn, "mass_factor", 1e3), str, "write masses in kg"),
    "tonnes": (lambda drawn: setattr(drawn, "mass_factor", 1e-3), str, "write masses in kg"),
    "massless": (lambda drawn: setattr(drawn, "massless", True), str, "states no masses"),
    "placeholder": (lambda drawn: setattr(drawn, "effort", 100.0), str, "is a placeholder"),
    "far stronger": (lambda drawn: setattr(drawn, "effort_factor", 40.0), str, "more than 10 times the load"),
    "far weaker": (lambda drawn: setattr(drawn, "effort_factor", 0.1), str, "less than the load"),
    "millimetres": (lambda drawn: None, lambda text: scaled_lengths(text, 1e3), "lengths in m"),
    "tiny": (lambda drawn: None, lambda text: scaled_lengths(text, 1e-3), "lengths in m|times the load|placeholder"),
}


@pytest.mark.sample(3)
@pytest.mark.parametrize("seed", range(40))
@pytest.mark.sample(8)
def test_a_drawn_defect_is_named_before_anything_moves(seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng([771, seed])
    change, rewrite, said = DEFECTS[str(random.choice(list(DEFECTS)))]
    drawn = DrawnModel(int(random.integers(1 << 30)))
    change(drawn)
    model = drawn.write(tmp_path)
    model.write_text(rewrite(model.read_text()))
    try:
        named = " ".join(drafted(model).draft.assumed)
    except BadInput as error:
        named = str(error)
    assert re.search(said, named), named


@pytest.mark.sample(3)
@pytest.mark.parametrize("seed", range(8))
def test_rounded_angles_and_mirrored_axes_are_no_defects(seed: int, tmp_path: Path) -> None:
    """Gravity is that of the exact model, with the sign of each joint that turns the other way."""
    random = np.random.default_rng([772, seed])
    model = DrawnModel(seed).write(tmp_path)
    exact = load_model(model)
    mirrored = random.random(exact.arm.n) < 0.5
    turn = np.pi * random.integers(-1, 2, exact.arm.n) / 2

    def read(angles: Callable[[float], float], mirror: bool) -> ModelArm:
        parts = text.split("<joint ")
        for i, turned in enumerate(turn):
            part = parts[i + 1].replace('xyz="', f'rpy="0 0 {angles(float(turned))!r}" xyz="', 1)
            axis = "0 1 0" if i % 2 == 0 else "0 0 1"
            flipped = axis.replace("1", "-1") if mirror and mirrored[i] else axis
            parts[i + 1] = part.replace(f'axis xyz="{axis}"', f'axis xyz="{flipped}"')
        model.write_text("<joint ".join(parts))
        return load_model(model)

    text, sign = model.read_text(), np.where(mirrored, -1.0, 1.0)
    poses = random.uniform(-1.4, 1.4, (20, exact.arm.n))
    plain, rounded = read(float, mirror=False), read(lambda angle: round(angle, 4), mirror=True)
    expected = gravity_torque(plain.arm, plain.beta, poses)
    found = sign * gravity_torque(rounded.arm, rounded.beta, sign * poses)
    assert np.abs(found - expected).max() < 3e-4 * np.abs(expected).max()
    assert not list(model_errors(drafted(model).parsed()))
