"""Robots that ship with batchpid: URDF files written by this project (see README.md in this
folder).
"""
