"""One self-contained page about a scene: pictures, numbers, curves and what is missing."""
