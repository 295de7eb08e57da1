"""Many run folders at once: found, described, chosen, compared, and drawn as a trend. Nothing here renders, scores or writes into them."""
