"""Functions as machine code, by numba."""

from __future__ import annotations

from typing import Any

import numba


def compiled(function: Any, **how: Any) -> Any:
    """The function as machine code, made at its first call and kept on disk where that is allowed.

    Other threads run meanwhile; divisions by zero give what numpy has for them. how: as for numba.njit.
    """
    how = {"nogil": True, "error_model": "numpy", **how}
    try:
        return numba.njit(cache=True, **how)(function)
    except RuntimeError:  # neither the project's folder nor the user's cache can be written
        return numba.njit(**how)(function)
