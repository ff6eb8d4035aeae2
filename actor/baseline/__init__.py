"""The scripted controller with true poses: what planning and control alone can reach."""
