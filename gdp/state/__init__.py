"""State of a running node as its control socket states it: requests, responses, status and tables. Sans-I/O."""
