"""An editor of masks in the browser: `rewild4d-bench masks --edit`.

`film` keeps the frames as JPEG, `work` what was drawn and every mask, with undo; `drawing` puts strokes into it, `job`
follows the animal in the background, `saving` reads and writes files, `requests` says what a page may ask for, `server`
answers it and `app` joins them. The page itself is in page/.
"""
