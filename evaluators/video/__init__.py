"""Quality of video against ground-truth frames: per frame, per clip, and over clips."""

from evaluators.video.clip import ClipQuality, clip_quality
from evaluators.video.frames import psnr_db, ssim
from evaluators.video.summary import summarise
from evaluators.video.warp import late_window, warp_l1

__all__ = ["ClipQuality", "clip_quality", "late_window", "psnr_db", "ssim", "summarise", "warp_l1"]
