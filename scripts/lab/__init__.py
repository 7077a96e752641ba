"""Laboratory: what demonstrations, tests and benches share to start, await, break and stop real processes."""
