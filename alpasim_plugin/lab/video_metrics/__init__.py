"""Quality of video against ground-truth frames: per frame, per clip, and over clips."""

from alpasim_plugin.lab.video_metrics.clip import ClipQuality, clip_quality
from alpasim_plugin.lab.video_metrics.frames import psnr_db, ssim
from alpasim_plugin.lab.video_metrics.summary import summarise
from alpasim_plugin.lab.video_metrics.warp import late_window, warp_l1

__all__ = ["ClipQuality", "clip_quality", "late_window", "psnr_db", "ssim", "summarise", "warp_l1"]
