"""A gRPC client of another make, which the tests run: tests/grpc/client.rs.

    client.py STUBS ADDRESS CALLS

CALLS is a JSON list; the calls are made one after the other over one channel. Of each call:

    request    the SubscribeRequest's fields
    token      goes into the metadata
    messages   ends the call after so many
    pause      reads that many messages, says `paused`, and reads on when a line comes in
    watch      while it is paused it says `over` when the call has ended
    beside     starts the next call before this one is read on, and reads that to its end first
    method     another method than Subscribe
    authority  another name for the service
    ca         a file of certificates: TLS

Each message is printed in hexadecimal digits, each call's end as `status CODE DETAILS`.
"""

import json
import sys

stubs, address, calls = sys.argv[1:]
sys.path.insert(0, stubs)

import grpc  # noqa: E402
import service_pb2  # noqa: E402
import service_pb2_grpc  # noqa: E402
import tracks_pb2  # noqa: E402


def open_channel(call):
    # A window that does not grow: what a slow reader does not take waits at the service.
    options = [("grpc.http2.bdp_probe", 0), ("grpc.enable_http_proxy", 0)]
    if "authority" in call:
        options.append(("grpc.default_authority", call["authority"]))
    if "ca" not in call:
        return grpc.insecure_channel(address, options)
    options.append(("grpc.ssl_target_name_override", "localhost"))
    with open(call["ca"], "rb") as file:
        return grpc.secure_channel(address, grpc.ssl_channel_credentials(file.read()), options)


def start(channel, call):
    request = service_pb2.SubscribeRequest(**call.get("request", {}))
    metadata = [("authorization", f"Bearer {call['token']}")] if "token" in call else []
    if "method" in call:
        subscribe = channel.unary_stream(
            call["method"],
            request_serializer=service_pb2.SubscribeRequest.SerializeToString,
            response_deserializer=tracks_pb2.TrackMessage.FromString,
        )
    else:
        subscribe = service_pb2_grpc.TracksStub(channel).Subscribe
    return subscribe(request, metadata=metadata)


def say(line):
    print(line, flush=True)


def read(call, stream, others):
    left = call.get("messages", -1)
    read = 0
    try:
        for message in stream:
            say(message.SerializeToString().hex())
            read += 1
            if read == call.get("pause"):
                say("paused")
                if call.get("watch"):
                    stream.add_callback(lambda: say("over"))
                if call.get("beside"):
                    others()
                sys.stdin.readline()
            left -= 1
            if left == 0:
                stream.cancel()
                return
        say("status OK")
    except grpc.RpcError as error:
        say(f"status {error.code().name} {error.details()}")


def main():
    left = json.loads(calls)
    channel = open_channel(left[0])

    def next_call():
        call = left.pop(0)
        read(call, start(channel, call), next_call)

    while left:
        next_call()


main()
