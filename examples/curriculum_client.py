"""A curriculum's client without this project: docs/curriculum-protocol.md in thirty lines.

python examples/curriculum_client.py ENDPOINT [RUN], for example tcp/127.0.0.1:7447 standalone
"""

import json
import sys
import zlib

import msgpack
import zenoh

KEYS = f"navaclq/{sys.argv[2] if len(sys.argv) > 2 else 'standalone'}/curriculum"


def pack(name, fields):
    """A message: schema version, type, fields."""
    return msgpack.packb([1, name, fields])


def ask(session, key, payload, attachment=None):
    """The fields of the one reply; ends the program with the sentence of a refusal."""
    for reply in session.get(f"{KEYS}/{key}", payload=payload, attachment=attachment, timeout=5.0):
        if reply.ok is None:
            sys.exit(f"refused: {reply.err.payload.to_string()}")
        return msgpack.unpackb(reply.ok.payload.to_bytes())[2]
    sys.exit(f"nobody answers {KEYS}/{key}")


config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
with zenoh.open(config) as session:
    tasks = ask(session, "task", pack("TaskQuery", {"cell": 0, "t": 0, "count": 2}))["tasks"]
    scores = ask(session, "score", pack("ScoreQuery", {"tasks": [{"task": p["task"]} for p in tasks]}))
    done = {"digest": {}, "proposal": tasks[0]["id"], "task": tasks[0]["task"], "success": True}
    outcome = pack("Outcome", done)
    # sender, its life (new in each: here the proposal's name), number in it, size and checksum
    header = msgpack.packb([["local/client", tasks[0]["id"], 0, len(outcome), zlib.crc32(outcome)]])
    receipt = ask(session, "result/local/client", outcome, header)
print(json.dumps({"tasks": tasks, "scores": scores, "receipt": receipt}))
