"""Short names for array types in signatures. Docstrings state the shapes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Bools = NDArray[np.bool_]
Integers = NDArray[np.integer]
Indices = NDArray[np.intp]
Floats = NDArray[np.floating]  # of any precision
Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Picture = NDArray[np.uint8]  # 8-bit RGB (H, W, 3) or gray (H, W)
