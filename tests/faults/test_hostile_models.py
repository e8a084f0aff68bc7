"""Model files of an attacker: entities, includes, files out of the folder; one line each, and no secret."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from armlink.errors import BadInput
from armlink.model_file import compile_model
from gcomp.arm.load import compile_model as compile_chain
from gcomp.errors import BadModel

SECRET = "swordfish"
BODY = (
    '<worldbody><body name="a"><joint name="j" type="hinge"/>'
    '<geom type="sphere" size="0.1" mass="1"/></body></worldbody>'
)
SHAPE = '<worldbody><body><joint type="hinge"/><geom type="mesh" mesh="m" mass="1"/></body></worldbody>'
BOMB = "".join(f'<!ENTITY a{i} "' + f"&a{i - 1};" * 10 + '">' for i in range(1, 10))
MODELS = {
    "an entity of another file": f'<!DOCTYPE m [<!ENTITY x SYSTEM "file://SECRET">]><mujoco model="&x;">'
    f"{BODY}</mujoco>",
    "a bomb of entities": f'<!DOCTYPE m [<!ENTITY a0 "bomb">{BOMB}]><mujoco model="&a9;">{BODY}</mujoco>',
    "an include of no model": f'<mujoco><include file="SECRET"/>{BODY}</mujoco>',
    "an include without an end": f'<mujoco><include file="/dev/zero"/>{BODY}</mujoco>',
    "an include of itself": f'<mujoco><include file="model.xml"/>{BODY}</mujoco>',
    "another file as a mesh": f'<mujoco><asset><mesh name="m" file="SECRET"/></asset>{SHAPE}</mujoco>',
    "another file as an STL mesh": f'<mujoco><asset><mesh name="m" file="SECRET.stl"/></asset>{SHAPE}</mujoco>',
    "another file as heights": f'<mujoco><asset><hfield file="SECRET" size="1 1 1 1"/></asset>{BODY}</mujoco>',
    "a device as heights": f'<mujoco><asset><hfield file="/dev/zero" size="1 1 1 1"/></asset>{BODY}</mujoco>',
    "a mesh whose name is longer than a file's": f'<mujoco><asset><mesh name="m" file="{"a" * 5000}"/></asset>{SHAPE}'
    "</mujoco>",
    "a plugin": f'<mujoco><extension><plugin plugin="../../evil"/></extension>{BODY}</mujoco>',
    "bodies without end": f"<mujoco><worldbody>{'<body>' * 5000}{'</body>' * 5000}</worldbody></mujoco>",
}
HARMLESS = {"an entity of another file", "a bomb of entities", "another file as a mesh"}
HARMLESS |= {"a mesh whose name is longer than a file's"}
"""Models that may also compile, since what is hostile in them is left out."""


@pytest.mark.parametrize("compiled", [compile_model, compile_chain], ids=["armlink", "gcomp"])
@pytest.mark.parametrize("what", MODELS)
def test_a_hostile_model_is_one_line_and_tells_no_secret(
    what: str, compiled: Callable[[Path], Any], tmp_path: Path
) -> None:
    (tmp_path / "folder").mkdir()
    for name in ("secret", "secret.stl"):
        (tmp_path / name).write_text(f"{SECRET}\n" * 100)
    path = tmp_path / "folder" / "model.xml"
    path.write_text(MODELS[what].replace("SECRET", str(tmp_path / "secret")))
    try:
        model = compiled(path)
    except (BadInput, BadModel) as error:
        said = str(error)
    else:
        assert what in HARMLESS
        assert SECRET.encode() not in bytes(model.names)
        assert len(model.names) < 10_000
        return
    assert SECRET not in said
    assert str(path) in said
    assert "\n" not in said
