"""Drop removal in pictures: the networks that the paper compares with, layer for layer."""
