"""Sans-I/O core of the checks: findings, explanations and the delegations that rules need."""
