"""Roll-outs that break loose leave nothing between the lines of a command."""

import mujoco
from wrong_arms import THREE, Wrong, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.model.load import silent

LIGHT = 'pos="0 0 0" mass="0.001" diaginertia="1e-12 1e-12 1e-12"'


def test_a_link_with_next_to_no_inertia_writes_no_warnings_of_the_simulator(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo keeps a log of its own
    text = THREE.replace('pos="0.04 0.01 0.10" mass="1.5" diaginertia="0.01 0.01 0.004"', LIGHT)
    (tmp_path / "arm.xml").write_text(text)
    model = mujoco.MjModel.from_xml_path("arm.xml")
    recording = record(model, Wrong(coulomb=0.6), seed=1, seconds=20, rate=50.0, noise=0.002, channels=("tau_motor",))
    capfd.readouterr()
    mujoco.set_mju_user_warning(None)  # as it is where a compiled model is given
    assert diagnose(model, [recording]).rollout is not None
    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_who_takes_the_warnings_does_so_again_afterwards():
    took, before = [], mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(took.append)
    try:
        with silent():
            pass
        assert mujoco.get_mju_user_warning() == took.append
    finally:
        mujoco.set_mju_user_warning(before)
