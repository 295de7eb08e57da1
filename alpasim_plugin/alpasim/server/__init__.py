"""Services that AlpaSim's runtime calls: the renderer's (`sensorsim`) and the driver's (`driver_service`)."""
