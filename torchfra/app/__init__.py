"""The command line and what stands behind it; nothing else in torchfra imports it."""
