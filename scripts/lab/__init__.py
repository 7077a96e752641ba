"""Laboratory of tests, benches, experiments and demonstrations: topologies as data, in memory and in namespaces.

Programs of the project are forked from a process that has imported them.
"""
