"""What runs on every machine of a cluster, whoever rents it out: the programs of its boot, kept up and told of."""
