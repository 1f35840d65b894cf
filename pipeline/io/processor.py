"""What a processor can do by itself."""

from __future__ import annotations

from llvmlite.binding import get_host_cpu_features


def multiplies_bfloat16(device: str = "cpu") -> bool:
    """Whether a device, cpu or cuda, has instructions for products of bfloat16 numbers.

    Without them such products take five times as long as float32's, not half.
    """
    if device != "cpu":
        return True
    features = get_host_cpu_features()
    return bool(features.get("avx512bf16") or features.get("amx-bf16"))
