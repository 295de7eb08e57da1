"""Clients of AlpaSim's services: any driver as a policy, any renderer as a renderer."""
