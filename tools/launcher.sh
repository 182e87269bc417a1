# The launcher .venv/bin/plumbline, after a first line that sets `made_in`, the checkout whose make wrote it.
# It runs the checkout that has the environment by whose path it was called: the environment may be a copy or a
# link to that of another checkout. -P keeps the current folder off the module path.
unset CDPATH
case $0 in */*) bin=$(cd "${0%/*}" && pwd) ;; *) bin= ;; esac
checkout=$(cd "$bin/../.." 2>/dev/null && pwd -P)
if [ -z "$bin" ] || [ ! -f "$checkout/plumbline/__main__.py" ] || [ ! -x "$bin/python" ]; then
	checkout=$made_in bin=$made_in/.venv/bin
fi
here=$(pwd -P)
while [ -n "$here" ] && [ ! -f "$here/plumbline/__main__.py" ]; do here=${here%/*}; done
if [ -n "$here" ] && [ "$here" != "$(cd "$checkout" && pwd -P)" ]; then
	echo "plumbline: this is the launcher of $checkout, but the current folder is in another checkout, $here:" \
		"call $here/.venv/bin/plumbline, or \`python -m plumbline\` there" >&2
	exit 2
fi
PYTHONPATH="$checkout${PYTHONPATH:+:$PYTHONPATH}" exec "$bin/python" -P -m plumbline "$@"
