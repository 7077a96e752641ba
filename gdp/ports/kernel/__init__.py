"""Kernel data plane: an eBPF program decides in the kernel, and Python decides the frames that it is unsure of."""
