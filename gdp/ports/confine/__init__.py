"""Confinement of this process after its sockets are open: capabilities, Landlock and seccomp."""
