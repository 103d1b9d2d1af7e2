"""One scene out of many: the scenes of a map, brought into one world, without what is there twice."""
