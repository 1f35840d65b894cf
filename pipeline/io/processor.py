"""What a processor can do by itself."""

from __future__ import annotations

from llvmlite.binding import get_host_cpu_features


def multiplies_bfloat16(device: str = "cpu") -> bool:
    """Whether a device, cpu or cuda, has instructions for products of bfloat16 numbers.

    A processor without them takes five times as long for such products as for float32's, not half.
    """
    if device != "cpu":
        import torch  # late: who asks for a processor needs none

        return torch.cuda.get_device_capability(device) >= (8, 0)
    features = get_host_cpu_features()
    return bool(features.get("avx512bf16") or features.get("amx-bf16"))
