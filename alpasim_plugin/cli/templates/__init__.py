"""What `simrun new` writes."""
