"""Short names for the types of arrays in signatures; docstrings give their shapes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Bools = NDArray[np.bool_]
Integers = NDArray[np.integer]
Floats = NDArray[np.floating]  # of any precision
Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
