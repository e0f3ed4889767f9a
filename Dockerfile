# The service with its models and ONNX Runtime.
#
#   docker build -t gakp .                        for CPUs (the target "cpu", the default)
#   docker build -t gakp:cuda --target cuda .     for NVIDIA GPUs: driver 580 or newer on the host
#   docker build -t gakp:demo --target demo .     the CPU's, with the demo film and its encoder
#
#   openssl rand -hex 32 > admin.token
#   docker run --rm -p 127.0.0.1:8080:8080 -v gakp:/var/lib/gakp \
#       -v ./admin.token:/run/secrets/admin.token:ro -e GAKP_ADMIN_TOKEN_FILE=/run/secrets/admin.token gakp
#
# A container listens to the network, so gakp wants a token before it starts.
# No network is needed at run time but the cameras'. docs/deploying.md has the rest. For builds that
# stay the same, give both images with their digests: --build-arg DEBIAN=debian@sha256:...

ARG DEBIAN=debian:12.12-slim
ARG RUST=rust:1.94-bookworm

FROM ${RUST} AS build
SHELL ["/bin/bash", "-euo", "pipefail", "-c"]
WORKDIR /gakp
# The set-up in the order of how seldom its inputs change: packages, models, page, code.
COPY Cargo.toml ./
COPY deploy/setup.sh deploy/
RUN bash deploy/setup.sh packages
COPY models models
RUN bash deploy/setup.sh models && rm -rf models/cache/nanodet models/build
COPY web web
RUN bash deploy/setup.sh page && rm -rf web/node_modules
COPY . .
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/gakp/target \
    bash deploy/setup.sh build && install -D target/release/gakp /out/gakp
RUN mkdir -p /out/models /out/onnxruntime \
    && cp -r models/manifest.toml models/README.md models/gakp-* models/cache /out/models/ \
    && mv /out/models/cache/libonnxruntime.so /out/onnxruntime/

# ONNX Runtime for CUDA, in the version of the CPU's, and the CUDA libraries that it wants: they come
# as Python wheels, of which only the libraries are kept.
FROM build AS cuda-libraries
COPY models/build/requirements.txt /tmp/requirements.txt
RUN version=$(sed -n 's/^onnxruntime==//p' /tmp/requirements.txt) \
    && python3 -m venv /venv \
    && /venv/bin/python -m pip install --no-cache-dir --disable-pip-version-check --only-binary :all: \
        "onnxruntime-gpu[cuda,cudnn]==$version" \
    && packages=$(echo /venv/lib/python3.*/site-packages) \
    && mkdir -p /opt/onnxruntime /opt/cuda \
    && cp "$packages"/onnxruntime/capi/libonnxruntime_providers_{shared,cuda}.so /opt/onnxruntime/ \
    && cp "$packages"/onnxruntime/capi/libonnxruntime.so.*.* /opt/onnxruntime/libonnxruntime.so \
    && find "$packages"/nvidia -name '*.so*' -exec cp --no-dereference {} /opt/cuda/ \;

FROM build AS film
RUN apt-get update && bash deploy/setup.sh footage

# What every variant has.
FROM ${DEBIAN} AS base
# base and good: RTSP and files; bad: h264parse and hardware decoders; libav: decoders. The test
# camera's encoder (ugly) is in the demo's image alone.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        ca-certificates libgstreamer1.0-0 libgstreamer-plugins-base1.0-0 libgstrtspserver-1.0-0 \
        gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-plugins-bad gstreamer1.0-libav \
    && rm -rf /var/lib/apt/lists/* \
    && groupadd --system --gid 10001 gakp \
    && useradd --system --uid 10001 --gid gakp --home-dir /var/lib/gakp --shell /usr/sbin/nologin gakp \
    && install -d -o gakp -g gakp -m 0700 /var/lib/gakp
COPY --from=build /out/gakp /usr/local/bin/gakp
COPY --from=build /gakp/LICENSE-MIT /gakp/LICENSE-APACHE /usr/share/doc/gakp/
COPY --from=build /out/models /usr/local/share/gakp/models
# The list of GStreamer's plugins is made anew in each container: the root may be read-only. Without
# ORT_DISABLE_TELEMETRY ONNX Runtime looks up a host of Microsoft's to send telemetry to.
ENV GAKP_MODELS=/usr/local/share/gakp/models \
    ORT_DYLIB_PATH=/opt/onnxruntime/libonnxruntime.so \
    STATE_DIRECTORY=/var/lib/gakp \
    GST_REGISTRY=/tmp/gstreamer-registry.bin \
    ORT_DISABLE_TELEMETRY=1
# By number: Kubernetes can tell from it that this is not root.
USER 10001:10001
WORKDIR /var/lib/gakp
EXPOSE 8080
# By bash: there is no curl in the image.
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s --retries=3 CMD ["/bin/bash", "-c", \
    "exec 3<>/dev/tcp/127.0.0.1/8080 && printf 'GET /healthz HTTP/1.0\\r\\nHost: localhost\\r\\n\\r\\n' >&3 && read -r line <&3 && [[ $line == *' 200 '* ]]"]
ENTRYPOINT ["gakp"]
CMD ["serve", "--listen", "0.0.0.0:8080"]

FROM base AS cuda
COPY --from=cuda-libraries /opt/onnxruntime /opt/onnxruntime
COPY --from=cuda-libraries /opt/cuda /opt/cuda
USER 0:0
RUN echo /opt/cuda > /etc/ld.so.conf.d/cuda.conf && ldconfig
USER 10001:10001
# video: cameras are decoded on the GPU where that works.
ENV NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility,video

FROM base AS demo
USER 0:0
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends gstreamer1.0-plugins-ugly \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /out/onnxruntime /opt/onnxruntime
COPY --from=film /gakp/models/cache/vtest.avi /usr/local/share/gakp/vtest.avi
USER 10001:10001

FROM base AS cpu
COPY --from=build /out/onnxruntime /opt/onnxruntime
