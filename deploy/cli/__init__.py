"""The navaclq command, one module per command group."""
