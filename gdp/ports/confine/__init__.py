"""Rights of this process: given away after its sockets are open, by capabilities, Landlock and seccomp."""
