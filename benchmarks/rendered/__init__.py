"""Clothed people rendered behind furniture, with the truth known: what perception is tuned and trained on.

Bodies are the packaged one's, clothes and hair MakeHuman's (CC0, given as a folder), furniture and rooms boxes.
"""
