"""Session protocol: sans-I/O cores of both ends, their messages and errors."""
