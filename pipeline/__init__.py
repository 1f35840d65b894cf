"""From photographs taken through wet glass to clean views of the scene behind it."""

# The SfM library exports a zlib of its own: the system's must be loaded first, or writing a PNG aborts.
import zlib  # noqa: F401
