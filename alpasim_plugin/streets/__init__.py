"""What a drawn scene is built of: ground, markings, facades, street furniture, road users."""
