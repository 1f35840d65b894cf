"""Cameras, poses, rays, the spaces that fields live in, and camera paths: arrays only, no files."""
