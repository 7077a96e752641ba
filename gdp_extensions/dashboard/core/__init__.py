"""Sans-I/O core of the live view: from snapshots of nodes to one scene, its readings and their series."""
