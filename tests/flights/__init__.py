"""Sample messages, replays and ULog files for tests."""
