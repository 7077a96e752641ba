"""Sans-I/O core of the endpoints: what each offers to the bridge, its QoS, and its schedule of reconnection."""
