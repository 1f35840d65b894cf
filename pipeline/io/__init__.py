"""Everything that touches a file: formats, names, paths and atomic writes."""
