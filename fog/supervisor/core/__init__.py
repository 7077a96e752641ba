"""Sans-I/O core of the supervisor: records in, actions out."""
