"""The stages: each reads artifact folders and one section of params.yaml, and writes one artifact."""

import os
import signal
import sys

# The SfM library exports a zlib of its own: the system's must be loaded first, or writing a PNG aborts.
import zlib  # noqa: F401


def _leave(signum: int, frame: object) -> None:
    os.write(2, b"interrupted before anything was done\n")
    os._exit(130)


# A stage takes a second or more to load; `pipeline.stage.run` listens from then on. Who was started with
# interrupts ignored goes on ignoring them.
_listening = signal.getsignal(signal.SIGINT) is signal.default_int_handler
if _listening and any(word.startswith("stages.") for word in sys.orig_argv):
    signal.signal(signal.SIGINT, _leave)
