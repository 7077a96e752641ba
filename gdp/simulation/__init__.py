"""Networks for tests: a topology as data, realised in kernel namespaces or in memory under a virtual clock."""
