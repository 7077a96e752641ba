"""Sans-I/O core of the AWS provider: requests for instances, and machines from responses."""
