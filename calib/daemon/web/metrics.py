"""GET /metrics: the daemon's metrics as Prometheus text; docs/daemon-api.md lists them."""

from collections.abc import Callable, Iterable

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from calib.daemon.view import Answer, DaemonView, State, Status
from calib.daemon.web.stream import Streams

PREFIX = "armlink_"
BUS = (
    ("rate_hz", "bus_rate_hertz", "Cycles (SYNC) per second."),
    ("load", "bus_load_ratio", "Bus load as a share of its capacity."),
)
BUS_COUNTERS = (
    ("frames", "bus_frames", "Frames sent and received since the bus was last opened."),
    ("missed", "bus_missed", "Sensor frames that did not arrive in their cycle."),
    ("late", "bus_late_cycles", "Cycles that began more than a tenth of a period late."),
    ("errors", "bus_errors", "Error frames and frames of a wrong length."),
)
JOINT = (
    ("position", "joint_position_radians", "Position sensor."),
    ("torque", "joint_torque_newton_metres", "Torque sensor reading, as the drive calibrates it."),
    ("model_torque", "joint_model_torque_newton_metres", "Gravity model at this position."),
    ("residual", "joint_residual_newton_metres", "Torque minus model torque; meaningful only at rest."),
    ("temperature", "joint_temperature_celsius", "Temperature of the drive, if it reports one."),
    ("external_torque", "joint_external_torque_newton_metres", "Torque with which the surroundings push the joint."),
    ("external_bound", "joint_external_bound_newton_metres", "Half width of the 95 % interval of this torque."),
    ("sample_age_s", "joint_sample_age_seconds", "Time since position and torque last arrived."),
)
ESTIMATE = (
    ("gain", "sensor_gain_ratio", "Gain relative to the current record; 1 is no change."),
    ("gain_std", "sensor_gain_std_ratio", "Standard deviation of the gain."),
    ("offset", "sensor_offset_newton_metres", "Offset relative to the current record; 0 is no change."),
    ("offset_std", "sensor_offset_std_newton_metres", "Standard deviation of the offset."),
    ("samples", "sensor_rests", "Number of rests of the arm used for the estimate."),
)


class DaemonCollector(Collector):
    def __init__(self, view: DaemonView, streams: Streams) -> None:
        self._view, self._streams = view, streams

    def collect(self) -> Iterable[Metric]:
        status = self._view.status()
        yield from _of_status(status)
        yield from _of_joints(JOINT, self._view.joints())
        yield from _of_joints(ESTIMATE, self._view.estimates())
        contacts = CounterMetricFamily(
            PREFIX + "contacts", "Contacts and loads since the daemon started.", labels=["kind"]
        )
        for kind, count in self._view.external().counts.items():
            contacts.add_metric([kind], count)
        yield contacts
        yield GaugeMetricFamily(PREFIX + "stream_clients", "Clients on the stream now.", self._streams.clients)
        yield CounterMetricFamily(
            PREFIX + "stream_cut_off",
            "Clients of the stream that were cut off because they did not read.",
            self._streams.cut_off,
        )


def metrics_text(view: DaemonView, streams: Streams) -> Callable[[], bytes]:
    registry = CollectorRegistry()
    registry.register(DaemonCollector(view, streams))
    ProcessCollector(registry=registry)
    return lambda: generate_latest(registry)


def _of_status(status: Status) -> Iterable[Metric]:
    identity = {"arm": status.arm, "serial": status.serial, "version": status.version, "policy": status.policy}
    yield InfoMetricFamily(PREFIX + "daemon", "Arm, software and policy.", identity)
    state = GaugeMetricFamily(PREFIX + "state", "1 for the state that the daemon is in.", labels=["state"])
    for each in State:
        state.add_metric([each.value], float(status.state is each))
    yield state
    yield GaugeMetricFamily(PREFIX + "uptime_seconds", "Time since the daemon started.", status.uptime_s)
    yield GaugeMetricFamily(PREFIX + "bus_connected", "1 while frames of the joints arrive.", status.bus.connected)
    for key, name, text in BUS:
        yield GaugeMetricFamily(PREFIX + name, text, getattr(status.bus, key))
    for key, name, text in BUS_COUNTERS:
        yield CounterMetricFamily(PREFIX + name, text, getattr(status.bus, key))
    yield GaugeMetricFamily(PREFIX + "estimates_held", "1 while the cause of an alarm is not known.", status.held)
    yield GaugeMetricFamily(
        PREFIX + "observed_rests", "Number of rests of the arm that the observer has used.", status.rows
    )
    yield GaugeMetricFamily(PREFIX + "proposals_pending", "Pending proposals.", status.pending_proposals)
    yield GaugeMetricFamily(PREFIX + "record_store_up", "1 while the record store answers.", not status.store_fault)
    yield GaugeMetricFamily(PREFIX + "journal_up", "1 while the journal can be written.", not status.journal_fault)
    yield CounterMetricFamily(
        PREFIX + "events", "Number of events, which is the id of the newest event.", status.last_event
    )


def _of_joints(families: Iterable[tuple[str, str, str]], joints: Iterable[Answer]) -> Iterable[Metric]:
    """One gauge per family, one value per joint; missing values are omitted."""
    joints = tuple(joints)
    for key, name, text in families:
        family = GaugeMetricFamily(PREFIX + name, text, labels=["joint"])
        for joint in joints:
            value = getattr(joint, key)
            if value is not None:
                family.add_metric([str(getattr(joint, "joint", ""))], value)
        yield family
