"""The Damiao family, as the registry finds it."""

from armlink.drives.damiao.drives import TRAITS, DamiaoDrives
from armlink.drives.damiao.settings import DamiaoSettings
from armlink.drives.family import Family

FAMILY = Family(
    "damiao", TRAITS, DamiaoSettings, DamiaoDrives, summary="Damiao DM-J (OpenArm, YAM, reBot B601-DM), MIT mode"
)
