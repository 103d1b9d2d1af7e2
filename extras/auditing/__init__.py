"""Which camera of a station has moved, when and by how much: recordings placed in a scene that was made before.

`stations` finds the cameras of each recording, `taken` the few photographs of them that are looked at, `sighting`
places these; `motion` measures how a camera moved between two photographs of the same place, `history` makes periods
and rigs of it, `table` and `picture` show them; `command` is the verb.
"""
