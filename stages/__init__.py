"""The stages: each reads artifact folders and one section of params.yaml, and writes one artifact."""

# The SfM library exports a zlib of its own: the system's must be loaded first, or writing a PNG aborts.
import zlib  # noqa: F401
