"""Laboratory of tests, benches, experiments and demonstrations: topologies as data, and what realises them.

``simulation`` and ``network`` work in memory, ``namespaces`` in the kernel, ``internet`` with sites behind NATs and
firewalls, ``datacenter`` with machines that boot.
``machine`` writes, starts, awaits and ends nodes; ``process`` has the processes, ``zygote`` forks them from a process
that has imported the project.
"""
