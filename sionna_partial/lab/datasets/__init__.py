"""Links of many homes: built on a cluster, kept in shards, read."""
