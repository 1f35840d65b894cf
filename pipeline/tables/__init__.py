"""The comparison of methods over scenes: pictures at the fits' size, statistics, tables, crops."""
