"""Stores of finished rollouts by URL: a folder, a shared file system, or an object store."""
