"""The interfaces of replaceable parts, and how a part is found, identified and built."""
