"""Prioritised replay: columns, sum tree and the durable log of episodes."""
