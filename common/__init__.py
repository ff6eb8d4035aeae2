"""What actors, learner and curriculum share: configuration, tasks, networks, messages and the bus."""
