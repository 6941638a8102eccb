"""Real containers on real networks: the compose files as shipped."""
