"""The navaclq command, the local launcher and everything that deploys the processes."""
