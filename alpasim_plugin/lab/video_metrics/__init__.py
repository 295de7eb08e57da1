"""Quality of video against ground-truth frames: per frame, per clip, and over clips."""
