"""Which camera of a station has moved, when and by how much: recordings placed in a scene that was made before.

`audit` finds the cameras of each recording, places the few photographs of them that are looked at, measures how a
camera moved between two photographs of the same place, and makes periods and rigs of it; `command` is the verb, and
shows them.
"""
