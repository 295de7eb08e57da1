"""Quality of video against the frames that there were to see: per frame, per clip, and over clips."""

from evaluators.video.psnr import psnr_db
from evaluators.video.ssim import ssim
from evaluators.video.warp import late_window, warp_l1

__all__ = ["late_window", "psnr_db", "ssim", "warp_l1"]
