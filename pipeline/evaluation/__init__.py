"""How close a view is to a reference, how well a mask fits, and the tables made of it."""
