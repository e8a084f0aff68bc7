"""An in-process CAN bus with the simulated arm on it: SYNC advances the physics by one period, nothing ever sleeps."""

from threading import RLock
from typing import Any

import can

from armlink.armfile import load_arm
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

SYNC_ID = 0x80


class SimulatedClock:
    """The simulated arm's time as a clock; sleeping lets the arm run."""

    def __init__(self, arm: SimulatedArm, lock: RLock) -> None:
        """The clock of `arm`, which `lock` guards."""
        self._arm, self._lock = arm, lock

    def now(self) -> float:
        """Simulated seconds since power-on."""
        return self._arm.time

    def sleep_until(self, instant: float) -> None:
        """Let simulated time pass until `instant` [s]; at once where it is past."""
        with self._lock:
            if instant > self._arm.time + 1e-9:
                self._arm.advance(instant - self._arm.time)


class LockStepBus(can.BusABC):  # type: ignore[misc]
    """One endpoint of a CAN bus whose other end is the arm. As a python-can interface: `armlink_sim:ARM`.

    `recv` pops what the nodes sent; where there is nothing and `timeout` is positive, simulated time passes instead,
    up to the first frame, and None is returned if none comes. A timeout of None is a second.
    """

    def __init__(self, channel: Any = None, *, arm: SimulatedArm | None = None, seed: int = 0, **kwargs: Any) -> None:
        """On the arm given, or on a new one from the arm file (or bundled arm) `channel`. Raises BadInput."""
        if arm is None:
            described = load_arm(str(channel))
            arm = SimulatedArm(described, Truth.of(described), seed)
        self.arm = arm
        self._lock = RLock()
        self.clock = SimulatedClock(arm, self._lock)
        self.channel_info = f"simulated arm {arm.arm.name}"
        self._outbox = arm.outbox
        super().__init__(channel=channel, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Deliver a frame to all nodes; a SYNC also advances the arm by one period."""
        self.put(msg.arbitration_id, bytes(msg.data))

    def put(self, can_id: int, data: bytes) -> None:
        """As send, without a message object."""
        arm = self.arm
        with self._lock:
            arm.on_frame(can_id, data)
            if can_id == SYNC_ID:
                arm.advance(arm.period)

    def take(self, timeout: float = 0.0) -> tuple[int, bytes] | None:
        """As recv, without a message object."""
        if not self._outbox and timeout > 0:
            self._wait(timeout)
        return self._outbox.popleft() if self._outbox else None

    def _wait(self, timeout: float) -> None:
        """Let time pass until a frame comes; another thread may send meanwhile, as python-can's Notifier has it."""
        deadline = self.arm.time + timeout
        while not self._outbox and self.arm.time < deadline - 1e-9:
            with self._lock:
                self.arm.advance(min(self.arm.period, deadline - self.arm.time))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame that a node sent, or None."""
        frame = self.take(1.0 if timeout is None else timeout)
        if frame is None:
            return None
        return can.Message(
            arbitration_id=frame[0],
            data=frame[1],
            is_extended_id=False,
            timestamp=self.arm.time,
            is_rx=True,
            check=False,
        )

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.recv(timeout), True
