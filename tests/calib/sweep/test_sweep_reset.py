"""A controller restarts in mid-sweep while another joint is under its bias torque: all end safe, the sweep resumes."""

from pathlib import Path

import numpy as np
import pytest
from sweep_arms import at_rate, random_arm, with_section

from armlink.drives.canopen.cia402 import DriveState
from armlink.errors import BusFault
from armlink.link.link import Link
from calib.dataset import load_data
from calib.sweep.run import run_sweep
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

ARM = with_section(
    at_rate(random_arm(31, 2), 100.0),
    steps=5,
    poses=1,
    max_samples=10,
    settle_window=0.08,
    gain_std=0.5,
    travel_speed=0.95,
)
TORQUE_MODE, PRESSED_CYCLES = 10, 160
SAFE = (DriveState.QUICK_STOP, DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)


class Resetting(LockStepBus):
    """Restarts the other joint once one has been under torque for some cycles."""

    pressed, reset = 0, ""

    def put(self, can_id: int, data: bytes) -> None:
        drives = self.arm.drives
        enabled = np.array([state is DriveState.ENABLED for state in drives.state])
        pressing = np.flatnonzero(enabled & (np.asarray(drives.loops.mode) == TORQUE_MODE))
        self.pressed += bool(pressing.size)
        if pressing.size == 1 and self.pressed > PRESSED_CYCLES and not self.reset:
            self.reset = self.arm.names[1 - int(pressing[0])]
            self.inject(f"node.reboot:{self.reset}")
        super().put(can_id, data)


def powered_on(seed: int) -> SimulatedArm:
    return SimulatedArm(ARM, Truth.draw(ARM, 3), seed)


def test_a_reset_in_mid_sweep_under_bias_torque_stops_all_and_the_sweep_resumes(tmp_path: Path) -> None:
    bus = Resetting(arm=powered_on(1))
    with Link(ARM, bus) as link:
        link.start()
        link.enable()
        with pytest.raises(BusFault, match="has restarted"):
            run_sweep(link, ARM, tmp_path / "sweep", resume=False, seed=0)
        assert bus.reset
        bus.clock.sleep_until(bus.clock.now() + 1.0)
        assert all(state in SAFE for state in bus.arm.drives.state)
        assert float(np.abs(bus.arm.plant.velocity).max()) < 1e-3

    with Link(ARM, LockStepBus(arm=powered_on(2))) as link:
        link.start()
        link.enable()
        run_sweep(link, ARM, tmp_path / "sweep", resume=True, seed=0)
    data = load_data(tmp_path / "sweep")
    assert data.complete
    assert data.plan is not None
    assert len({(reading.sweep, reading.index) for reading in data.readings}) == data.plan.readings
