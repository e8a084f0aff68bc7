"""The CubeMars family, as the registry finds it."""

from armlink.drives.cubemars.drives import TRAITS, CubeMarsDrives
from armlink.drives.cubemars.settings import CubeMarsSettings
from armlink.drives.family import Family

FAMILY = Family(
    "cubemars", TRAITS, CubeMarsSettings, CubeMarsDrives, summary="CubeMars AK (firmware 1 and 2), MIT mode"
)
