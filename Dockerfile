# The service with its models and ONNX Runtime for CPUs.
#
#   docker build -t gakp .
#   docker run --rm -p 8080:8080 gakp serve --listen 0.0.0.0:8080 --camera gate=rtsp://...

FROM rust:1-bookworm AS build
WORKDIR /gakp
# The set-up in the order of how seldom its inputs change: packages, models, code.
COPY Cargo.toml ./
COPY deploy/setup.sh deploy/
RUN bash deploy/setup.sh packages
COPY models models
RUN bash deploy/setup.sh models && rm -rf models/cache/nanodet
COPY . .
RUN bash deploy/setup.sh build

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        ca-certificates libgstreamer1.0-0 libgstreamer-plugins-base1.0-0 libgstrtspserver-1.0-0 \
        gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-plugins-bad \
        gstreamer1.0-plugins-ugly gstreamer1.0-libav \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --system --create-home --home-dir /gakp gakp
WORKDIR /gakp
COPY --from=build /gakp/target/release/gakp /usr/local/bin/gakp
COPY --from=build /gakp/models models
USER gakp
EXPOSE 8080
ENTRYPOINT ["gakp"]
CMD ["serve", "--listen", "0.0.0.0:8080"]
