"""Provider of local machines: network namespaces with their own processes, for tests with injected faults."""
