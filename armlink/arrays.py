"""The array type of the wire side: float64, shapes stated where it is used."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
