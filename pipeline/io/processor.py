"""What the processor can do by itself."""

from __future__ import annotations

from llvmlite.binding import get_host_cpu_features


def multiplies_bfloat16() -> bool:
    """Whether the processor has instructions for products of bfloat16 numbers."""
    features = get_host_cpu_features()
    return bool(features.get("avx512bf16") or features.get("amx-bf16"))
