"""The building that the building camera walks through: rooms around a corridor, their furniture, and the walk."""
