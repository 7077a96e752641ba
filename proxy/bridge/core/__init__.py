"""Sans-I/O core of the bridge: which flows it carries, who carries them, and how messages are coded."""
