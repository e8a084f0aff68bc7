"""An arm's own work, learned once and kept in a file, for as long as the same records are in force."""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armlink.content.atomic_file import write_whole
from armlink.errors import BadInput
from calib.external.arm_model import ArmListener, ArmRecords
from calib.external.listening import WrenchFrame
from gcomp.external.external_model import ExternalModel, Spread

SCHEMA = "armlink.external-learned/2"
SPREADS, ARRAYS = ("lasting", "sudden"), ("links", "joints", "factors", "scale")
OF_SPREAD = ("weights", "still", "moving", "correlation")


@dataclass(frozen=True, eq=False)
class Learned:
    """All that listening needs."""

    listener: ArmListener
    frame: WrenchFrame
    per_hour: float
    """Allowed rate of false alarms [1/h]."""


def save_learned(path: Path, learned: Learned) -> None:
    """Write it; raises OSError."""
    listener, model = learned.listener, learned.listener.model
    content: dict[str, Any] = {name: getattr(model, name) for name in ARRAYS}
    for spread in SPREADS:
        content |= {f"{spread}_{name}": getattr(getattr(model, spread), name) for name in OF_SPREAD}
    content |= {f"maxima_{k}": each for k, each in enumerate(model.maxima)}
    content["schema"] = SCHEMA
    content |= {"seconds": model.seconds, "channel": listener.channel, "rate": listener.rate}
    content |= {"names": model.arm.names, "records": _ids(listener.records), "per_hour": learned.per_hour}
    content |= {"link": learned.frame.link, "point": learned.frame.point}
    if listener.warm is not None:
        content["warm"] = listener.warm
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **content)
    write_whole(path, stream.getvalue())


def load_learned(path: Path, records: ArmRecords) -> Learned:
    """Raises BadInput where it cannot be read, or was learned of another arm or with other records."""
    arm = records.stated.arm
    try:
        with np.load(path, allow_pickle=False) as file:
            content = dict(file)
        if str(content["schema"]) != SCHEMA:
            raise BadInput(f"{path}: schema is {content['schema']}, expected {SCHEMA}: learn again with --baseline")
        if tuple(content["names"].tolist()) != arm.names or tuple(content["records"].tolist()) != _ids(records):
            raise BadInput(f"{path}: was learned from another arm or other records: learn again with --baseline")
        spreads = [Spread(*(content[f"{spread}_{name}"] for name in OF_SPREAD)) for spread in SPREADS]
        maxima = content["maxima_0"], content["maxima_1"]
        links, joints, factors, scale = (content[name] for name in ARRAYS)
        model = ExternalModel(
            arm, links, joints, factors, spreads[0], spreads[1], maxima, scale, float(content["seconds"])
        )
        listener = ArmListener(model, records, str(content["channel"]), float(content["rate"]), content.get("warm"))
        return Learned(listener, WrenchFrame(int(content["link"]), content["point"]), float(content["per_hour"]))
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError, zipfile.BadZipFile):
        raise BadInput(f"{path}: is not a file that --learned has written: learn again with --baseline") from None


def _ids(records: ArmRecords) -> tuple[str, str]:
    """Of the records in use; empty for none."""
    calibration, gravity = records.calibration, records.gravity
    return "" if calibration is None else calibration.id, "" if gravity is None else gravity.id
