"""Uses a service in every way for a while, then looks for its secrets in all that it has said.

    .venv-tests/bin/python tests/soak/soak.py --gakp target/release/gakp --film models/cache/vtest.avi --seconds 3600

RTSP cameras with passwords (right, wrong, refused, malformed addresses), tokens of each role, revoked and made up,
sign-ins, WebSockets, a webhook with a signing secret and a key in its address, a broker with a password, reloads,
log levels down to trace, killed cameras, a killed service. Then no log, answer, metric, event, message, report or
history may hold a camera's password, a token or another secret, as it is or as it travels (percent or base64).
Prints what was done and how large the haystack was; exit code 1 if anything was found. Needs mosquitto and its clients.
"""

import argparse
import base64
import http.client
import http.server
import itertools
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from urllib.parse import quote

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

CAMERAS = 2
TRACE = "trace"


class Haystack:
    """What the service has said, by where. Held in files: an hour of it is large."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.lock = threading.Lock()
        self.done: Counter[str] = Counter()
        folder.mkdir()

    def add(self, where: str, what: str | bytes) -> None:
        with self.lock, (self.folder / where).open("ab") as file:
            file.write(what.encode(errors="replace") if isinstance(what, str) else what)
            file.write(b"\n")

    def count(self, what: str) -> None:
        with self.lock:
            self.done[what] += 1


class Secrets:
    """What nobody may see. What the service has given out is kept here, too: a token is shown once, to its owner."""

    def __init__(self):
        self.named: dict[str, str] = {}

    def new(self, name: str, value: str) -> str:
        self.named[f"{name} {len(self.named)}"] = value
        return value

    def needles(self):
        for name, value in self.named.items():
            forms = {value, quote(value, safe=""), json.dumps(value)[1:-1]}
            # Three ways to be cut into groups of three bytes; without what the neighbours decide.
            for pad in range(3):
                coded = base64.b64encode(b"x" * pad + value.encode()).decode().rstrip("=")
                forms.add(coded[4 if pad else 0 : -2])
            for form in forms:
                yield name, form.encode()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Soak:
    def __init__(self, args, folder: Path):
        self.args, self.folder = args, folder
        self.rng = random.Random(args.seed)
        self.said, self.secrets = Haystack(folder / "said"), Secrets()
        self.port, self.state = free_port(), folder / "state"
        self.processes: list[subprocess.Popen] = []
        self.names = (f"cam{n}" for n in itertools.count())
        self.ends = time.monotonic() + args.seconds
        word = lambda: f"{self.rng.getrandbits(64):016x}"
        self.secret = lambda name, shape="{}": self.secrets.new(name, shape.format(word()))
        self.tokens = {role: self.make_token(role, role) for role in ("viewer", "operator", "admin")}
        self.cookies: list[str] = []
        self.passwords = [self.secret("camera password", "p@ss/{}:#"), self.secret("camera password", "geheim{}")]
        self.cameras = [free_port() for _ in range(CAMERAS)]
        self.rtsp: list[subprocess.Popen | None] = [None] * CAMERAS
        self.service: subprocess.Popen | None = None

    # Processes

    def spawn(self, command: list, where: str, **options) -> subprocess.Popen:
        log = (self.said.folder / where).open("ab")
        process = subprocess.Popen([str(c) for c in command], stdout=log, stderr=log, **options)
        self.processes.append(process)
        return process

    def gakp(self, *arguments) -> str:
        done = subprocess.run(
            [str(self.args.gakp), *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False
        )
        self.said.add("commands", done.stderr)
        return done.stdout

    def make_token(self, name: str, role: str) -> str:
        token = self.gakp("token", "--state-dir", self.state, "create", name, "--role", role).strip()
        assert token, "no token was made"
        return self.secrets.new(f"token of {name}", token)

    def start_camera(self, index: int) -> None:
        options = ["--listen", f"127.0.0.1:{self.cameras[index]}", "--user", "guard", "--fps", "5"]
        # Its own log is not the service's; it gets its password where no list of processes shows it.
        environment = {**os.environ, "GAKP_CAMERA_PASSWORD": self.passwords[index]}
        command = [str(self.args.gakp), "camera", str(self.args.film), *options]
        self.rtsp[index] = subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self.processes.append(self.rtsp[index])

    def start_broker(self) -> int:
        port, password = free_port(), self.secret("broker's password")
        folder = self.folder / "broker"
        folder.mkdir(mode=0o755)
        os.chmod(self.folder, 0o755)
        users = folder / "users"
        subprocess.run(["mosquitto_passwd", "-b", "-c", users, "gakp", password], check=True, capture_output=True)
        os.chmod(users, 0o644)
        config = folder / "broker.conf"
        config.write_text(f"listener {port} 127.0.0.1\npassword_file {users}\nallow_anonymous false\n")
        server = shutil.which("mosquitto", path=os.environ["PATH"] + ":/usr/sbin")
        log = (folder / "log").open("ab")
        self.processes.append(subprocess.Popen([server, "-c", config], stdout=log, stderr=log))
        self.broker = (port, password)
        time.sleep(1)
        listen = ["mosquitto_sub", "-p", str(port), "-u", "gakp", "-P", password, "-v", "-t", "#"]
        self.spawn(listen, "mqtt")
        return port

    def start_receiver(self) -> int:
        soak = self

        class Receiver(http.server.BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers.get("content-length", 0)))
                head = "\n".join(f"{name}: {value}" for name, value in self.headers.items())
                soak.said.add("webhook", head.encode() + b"\n" + body)
                soak.said.count("webhook posts")
                self.send_response(soak.rng.choice([204, 204, 204, 500]))
                self.end_headers()

            def log_message(self, *_):
                pass

        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        return server.server_address[1]

    def configure(self) -> None:
        broker, receiver = self.start_broker(), self.start_receiver()
        self.receiver = receiver
        signing = self.secrets.new("webhook secret", "whsec_" + base64.b64encode(self.rng.randbytes(24)).decode())
        key = self.secret("webhook key")
        door = 'points = [[0.5, 1.0], [0.5, 0.0]]'
        self.config = self.folder / "gakp.toml"
        self.text = f"""
[history]
snapshots = true
[[webhook]]
name = "alarm"
url = "http://127.0.0.1:{receiver}/hook?key={key}"
secret = "{signing}"
[[webhook]]
name = "nowhere"
url = "http://user:{self.secret("webhook password")}@127.0.0.1:{free_port()}/"
[mqtt]
url = "mqtt://127.0.0.1:{broker}"
user = "gakp"
password = "{self.broker[1]}"
[[camera]]
id = "configured"
url = "{self.camera_url(0)}"
[[camera.lines]]
id = "door"
{door}
"""
        self.config.write_text(self.text)
        self.admin_file = self.folder / "admin.token"
        self.admin_file.write_text(self.secret("admin's token file", "{0}{0}{0}"))
        self.tokens["file"] = self.admin_file.read_text()

    def start_service(self) -> None:
        self.service = self.spawn(
            [
                self.args.gakp, "serve", "--config", self.config, "--state-dir", self.state, "--provider", "cpu",
                "--listen", f"127.0.0.1:{self.port}", "--admin-token-file", self.admin_file,
                *(["--log-json"] if self.rng.random() < 0.5 else []),
            ],
            "log",
        )
        for _ in range(600):
            if self.service.poll() is not None:
                raise SystemExit(f"the service ended: {(self.said.folder / 'log').read_text()[-2000:]}")
            try:
                if self.ask("GET", "/healthz", None)[0] == 200:
                    return
            except OSError:
                time.sleep(0.1)
        raise SystemExit("the service does not answer")

    # What is done

    def camera_url(self, index: int, password: str | None = None) -> str:
        password = quote(password or self.passwords[index], safe="")
        return f"rtsp://guard:{password}@127.0.0.1:{self.cameras[index]}/live"

    def ask(self, method: str, path: str, token: str | None, body=None, cookie: str | None = None):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        headers = {}
        if token:
            headers["Authorization"] = f"Bearer {token}"
        if cookie:
            headers |= {"Cookie": cookie, "Origin": f"http://127.0.0.1:{self.port}"}
        if body is not None:
            headers["Content-Type"] = "application/json"
            body = body if isinstance(body, str) else json.dumps(body)
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            found = answer.read(3_000_000)
            fields = answer.getheaders()
        finally:
            connection.close()
        # The one place where a session's secret belongs.
        shown = [(n, v) for n, v in fields if n.lower() != "set-cookie"]
        where = "metrics" if path == "/metrics" else "answers"
        self.said.add(where, f"{answer.status} {shown}\n".encode() + found)
        self.said.count(f"{method} {answer.status}")
        return answer.status, dict(fields), found

    def who(self) -> str:
        return self.rng.choice(list(self.tokens.values()))

    def read(self) -> None:
        camera = self.rng.choice(["configured", "cam0", "nope"])
        path = self.rng.choice([
            "/v1/cameras", f"/v1/cameras/{camera}", f"/v1/cameras/{camera}/counts", f"/v1/cameras/{camera}/lines",
            f"/v1/cameras/{camera}/heatmap", "/v1/events?limit=1000", "/v1/history", "/v1/history/tracks?limit=50",
            "/v1/history/events?limit=50", "/v1/history/tracks.csv", "/v1/webhooks", "/v1/session", "/v1/log",
            "/metrics", "/readyz", "/", "/v1/openapi.json", f"/v1/cameras/{camera}/snapshot.jpg",
        ])
        token = self.rng.choice([self.who(), self.who(), None, "gakp_" + "0" * 40])
        self.ask("GET", path, token)

    def misplace_a_token(self) -> None:
        """As careless programs do: in the query, in a path, as another scheme."""
        token = self.who()
        self.ask("GET", f"/v1/tracks?token={token}", None)
        self.ask("GET", f"/v1/cameras?access_token={token}", self.tokens["viewer"])
        self.ask("POST", "/v1/session", None, {"token": token, "extra": 1})
        self.ask("POST", "/v1/session", None, f'{{"token": "{token}"')

    def add_camera(self) -> None:
        index = self.rng.randrange(CAMERAS)
        wrong = self.secret("wrong camera password", "falsch{}")
        refused = free_port()
        url = self.rng.choice([
            self.camera_url(index), self.camera_url(index), self.camera_url(index, wrong),
            self.camera_url(index, wrong).replace("/live", "/nothing"),
            f"rtsp://guard:{wrong}@127.0.0.1:{refused}/live", f"rtsp://guard:{wrong}@[::1/live",
            f"rtsp://guard:{wrong}@127.0.0.1:99999/live", f"rtps://guard:{wrong}@127.0.0.1/live",
            f"http://guard:{wrong}@127.0.0.1:{refused}/stream", f"rtsps://guard:{wrong}@127.0.0.1:{refused}/live",
            f"rtsp://guard:{wrong}@169.254.1.1/live", f"file://guard:{wrong}@/etc/passwd",
        ])
        name = next(self.names)
        body = {"id": name, "url": url}
        self.ask("POST", "/v1/cameras", self.rng.choice([self.tokens["admin"], self.tokens["operator"], self.who()]), body)
        spoiled = self.rng.choice([
            json.dumps(body)[:-1], json.dumps({**body, "transport": "x"}), json.dumps({**body, "more": wrong[:3]}),
            json.dumps({"id": name, "url": {"address": url}}), json.dumps([url]), json.dumps({"id": 7, "url": url}),
        ])
        self.ask("POST", "/v1/cameras", self.tokens["admin"], spoiled)

    def some_camera(self) -> str:
        _, _, body = self.ask("GET", "/v1/cameras", self.tokens["admin"])
        return self.rng.choice([c["id"] for c in json.loads(body)["cameras"]] or ["configured"])

    def change_camera(self) -> None:
        index = self.rng.randrange(CAMERAS)
        wrong = self.secret("wrong camera password", "anders{}")
        patch = self.rng.choice([
            {"url": self.camera_url(index)}, {"url": self.camera_url(index, wrong)}, {"paused": True}, {"paused": False},
            {"transport": "udp"}, {"url": f"rtsp://guard:{wrong}@[/x"}, {"url": self.camera_url(index), "transport": "tcp"},
        ])
        self.ask("PATCH", f"/v1/cameras/{self.some_camera()}", self.tokens["admin"], patch)

    def remove_cameras(self) -> None:
        _, _, body = self.ask("GET", "/v1/cameras", self.tokens["admin"])
        names = [c["id"] for c in json.loads(body)["cameras"] if c["id"] != "configured"]
        for name in names[:-3]:
            self.ask("DELETE", f"/v1/cameras/{name}", self.tokens["operator"])

    def draw(self) -> None:
        path = f"/v1/cameras/{self.some_camera()}"
        square = [[0, 0], [1, 0], [1, 1], [0, 1]]
        for kind, shape in [("lines", [[0.5, 1], [0.5, 0]]), ("zones", square), ("masks", square)]:
            self.ask("PUT", f"{path}/{kind}/a", self.tokens["admin"], {"id": "a", "points": shape})
        self.ask("DELETE", f"{path}/masks/a", self.tokens["admin"])

    def change_webhooks(self) -> None:
        """Right and wrong ones, of an admin and of an operator; some take posts."""
        key, password = self.secret("webhook key"), self.secret("webhook password", "haken{}")
        signing = self.secrets.new("webhook secret", "whsec_" + base64.b64encode(self.rng.randbytes(24)).decode())
        url = self.rng.choice([
            f"http://127.0.0.1:{self.receiver}/hook?key={key}", f"http://user:{password}@127.0.0.1:{free_port()}/{key}",
            f"http://user:{password}@169.254.1.1/", f"ftp://user:{password}@127.0.0.1/", f"http://user:{password}@127.0.0.1:x/",
        ])
        name = next(self.names)
        body = {"name": name, "url": url, "secret": self.rng.choice([signing, signing, signing[6:]])}
        token = self.rng.choice([self.tokens["admin"], self.tokens["admin"], self.tokens["operator"]])
        self.ask("POST", "/v1/webhooks", token, body)
        self.ask("POST", "/v1/webhooks", token, self.rng.choice([json.dumps(body)[:-1], json.dumps({**body, "url": [url]})]))
        _, _, found = self.ask("GET", "/v1/webhooks", self.tokens["admin"])
        names = [hook["name"] for hook in json.loads(found)["webhooks"] if hook["source"] == "api"]
        for other in names[-2:]:
            self.ask("POST", f"/v1/webhooks/{other}/test", token)
            self.ask("PATCH", f"/v1/webhooks/{other}", token, self.rng.choice([{"url": url}, {"secret": signing}, {"secret": None}]))
        for other in names[:-4]:
            self.ask("DELETE", f"/v1/webhooks/{other}", token)

    def sign_in_and_out(self) -> None:
        status, head, _ = self.ask("POST", "/v1/session", None, {"token": self.who()})
        cookie = next((v for n, v in head.items() if n.lower() == "set-cookie"), "").split(";")[0]
        if status == 200 and cookie:
            self.secrets.new("session", cookie.split("=", 1)[1])
            self.ask("GET", "/v1/cameras", None, cookie=cookie)
            self.ask("DELETE", "/v1/session", None, cookie=cookie)
            self.ask("GET", "/v1/cameras", None, cookie=cookie)
        self.ask("POST", "/v1/session", None, {"token": "gakp_wrong"})

    def revoke_a_token(self) -> None:
        token = self.make_token("guest", self.rng.choice(["viewer", "operator"]))
        self.ask("GET", "/v1/session", token)
        self.said.add("commands", self.gakp("token", "--state-dir", self.state, "list"))
        self.gakp("token", "--state-dir", self.state, "revoke", "guest")
        time.sleep(1.2)
        self.ask("GET", "/v1/cameras", token)

    def listen(self) -> None:
        path = self.rng.choice(["/v1/tracks", "/v1/events/live", "/v1/cameras/configured/live", "/v1/tracks?camera=nope"])
        token = self.rng.choice([self.who(), "gakp_" + "0" * 40])

        def run():
            until = time.monotonic() + 8
            try:
                headers = {"Authorization": f"Bearer {token}"}
                with connect(f"ws://127.0.0.1:{self.port}{path}", additional_headers=headers, compression=None) as ws:
                    self.said.count("WebSockets")
                    while time.monotonic() < until:
                        self.said.add("messages", ws.recv(timeout=2))
            except (WebSocketException, TimeoutError, OSError) as error:
                self.said.add("messages", repr(error))
                response = getattr(error, "response", None)
                if response is not None:
                    self.said.add("messages", response.body or b"")

        threading.Thread(target=run, daemon=True).start()

    def set_log(self) -> None:
        level = self.rng.choice(["info", "debug", TRACE, TRACE, f"info,gakp={TRACE}"])
        self.ask("PUT", "/v1/log", self.tokens["admin"], {"level": level})

    def reload(self) -> None:
        password = self.secret("wrong camera password", "neu{}")
        more = f'[[camera]]\nid = "later"\nurl = "{self.camera_url(1, password)}"\n'
        broken = f'[[camera]]\nid = "later"\nurl = {self.camera_url(1, password)}\n'
        hook = f'[[webhook]]\nname = "later"\nurl = "http://127.0.0.1:{free_port()}/{self.secret("webhook key")}"\n'
        wrong = f'[[webhook]]\nurl = "http://127.0.0.1/"\nsecret = "{self.secret("webhook secret")}"\n'
        self.config.write_text(self.text + self.rng.choice([more, broken, hook, wrong, ""]))
        if self.rng.random() < 0.5:
            self.service.send_signal(signal.SIGHUP)
            time.sleep(0.5)
        else:
            self.ask("POST", "/v1/reload", self.tokens["admin"])
        self.said.add("commands", self.gakp("check", "--config", self.config, "--state-dir", self.state, "--provider", "cpu"))
        self.config.write_text(self.text)

    def kill_a_camera(self) -> None:
        index = self.rng.randrange(CAMERAS)
        self.rtsp[index].kill()
        self.rtsp[index].wait()
        if self.rng.random() < 0.5:
            self.passwords[index] = self.secret("camera password", "w3chsel{}")
        self.start_camera(index)

    def restart_service(self) -> None:
        self.service.send_signal(self.rng.choice([signal.SIGTERM, signal.SIGKILL]))
        self.service.wait(timeout=30)
        self.start_service()

    def run(self) -> int:
        for index in range(CAMERAS):
            self.start_camera(index)
        self.configure()
        self.start_service()
        self.ask("PUT", "/v1/log", self.tokens["admin"], {"level": TRACE})
        deeds = [
            (self.read, 30), (self.misplace_a_token, 3), (self.add_camera, 8), (self.change_camera, 6), (self.remove_cameras, 2),
            (self.draw, 3), (self.change_webhooks, 3), (self.sign_in_and_out, 3), (self.revoke_a_token, 1), (self.listen, 4), (self.set_log, 2),
            (self.reload, 1), (self.kill_a_camera, 1), (self.restart_service, 0.5),
        ]
        # Each at least once, however short it is.
        first = [deed for deed, _ in deeds]
        while first or time.monotonic() < self.ends:
            deed = first.pop(0) if first else self.rng.choices(*zip(*deeds))[0]
            self.said.count(deed.__name__)
            deed()
            time.sleep(self.rng.uniform(0, 0.2) if self.args.seconds < 600 else self.rng.uniform(0, 1.5))
        self.set_log()
        time.sleep(2)
        self.ask("GET", "/metrics", self.tokens["admin"])
        self.service.send_signal(signal.SIGTERM)
        status = self.service.wait(timeout=30)
        assert status == 0, f"the service ended with {status}"
        return self.look()

    def look(self) -> int:
        print("done:", ", ".join(f"{what} {count}" for what, count in sorted(self.said.done.items())))
        places = sorted(self.said.folder.iterdir()) + sorted(self.state.glob("history*"))
        print("looked at:", ", ".join(f"{place.name} {place.stat().st_size:,} bytes" for place in places))
        assert all((self.said.folder / name).stat().st_size for name in ("log", "answers", "metrics", "mqtt", "messages"))
        assert (self.said.folder / "log").read_bytes().count(b"DEBUG"), "only the log of level info was seen"
        # One that is sure to be there: what finds nothing must be able to find.
        canary = self.secrets.new("canary", "kanarie-9c1f")
        sung = f"x {quote(canary)} y", base64.b64encode(f"guard:{canary}".encode()).decode()
        needles = list(self.secrets.needles())
        found = []
        for place in places:
            hay = place.read_bytes()
            for name, needle in needles:
                at = hay.find(needle)
                if at >= 0:
                    found.append((place.name, name, hay[max(0, at - 120) : at + 60]))
        for song in sung:
            hay = song.encode()
            assert any(needle in hay for name, needle in needles if name.startswith("canary")), song
        for place, name, around in found[:20]:
            print(f"FOUND {name} in {place}: {around!r}")
        print(f"{len(self.secrets.named)} secrets in {len(needles)} forms: found {len(found)} times")
        return 1 if found else 0

    def stop(self) -> None:
        for process in self.processes:
            if process.poll() is None:
                process.kill()
                process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gakp", type=Path, required=True)
    parser.add_argument("--film", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=3600)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, required=True, help="an empty folder; what was said is left in it")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    soak = Soak(args, args.folder.resolve())
    try:
        return soak.run()
    finally:
        soak.stop()


if __name__ == "__main__":
    sys.exit(main())
