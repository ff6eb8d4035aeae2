"""The classical rivals: B0 with true poses, the ceiling of planning and control; B1 and B2 that sense."""
