"""Maps between the ego's motion and the messages of a CAN database."""
