"""Runtime of one node: the loop that gives a sans-I/O core its frames, timers and signals. I/O."""
