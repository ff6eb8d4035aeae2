"""The learner: replay, soft actor-critic, checkpoints and the process that owns them."""
