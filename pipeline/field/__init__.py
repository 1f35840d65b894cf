"""The radiance field: encodings, networks, samplers, volume rendering, losses, the fit."""
