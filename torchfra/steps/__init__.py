"""How steps become tracks: one loop forwards and one backwards, the records of a step, and the engine that runs it."""
