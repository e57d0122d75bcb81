"""Shapes and element types of arrays, as annotations: `Float[np.ndarray, "n 3"]`.

They are jaxtyping's for type checkers and in tests. Other processes do not load it: 6 MB and 70 ms
of CPU.
"""

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import Bool, Float, Int64, UInt8, UInt32
else:

    class _Array:
        def __class_getitem__(cls, annotated: tuple[Any, str]) -> Any:
            return annotated[0]

    Bool = Float = Int64 = UInt8 = UInt32 = _Array

__all__ = ["Bool", "Float", "Int64", "UInt8", "UInt32"]
