"""The data plane whose decision is an eBPF program in the kernel; what it is unsure of, Python decides."""
