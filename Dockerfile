# splatvk with everything it needs, on the CPU (Mesa's lavapipe); a GPU works where its driver is passed in.
#   docker build -t splatvk . && docker run --rm -v "$PWD:/work" -w /work splatvk run photos --views 4 --out scene
FROM debian:12 AS build
WORKDIR /src
COPY . .
ENV SPLATVK_HOME=/usr/local/share/splatvk-home
RUN tools/setup && . "$HOME/.cargo/env" && tools/install --prefix /usr/local

FROM debian:12-slim
RUN apt-get update -q \
    && apt-get install -q -y --no-install-recommends libvulkan1 mesa-vulkan-drivers libgcc-s1 libstdc++6 libheif1 ffmpeg \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /usr/local/bin/splatvk /usr/local/bin/splatvk
COPY --from=build /usr/local/lib/libsplatvk.so* /usr/local/lib/
COPY --from=build /usr/local/share/splatvk-home /usr/local/share/splatvk-home
ENV SPLATVK_HOME=/usr/local/share/splatvk-home
RUN ldconfig && splatvk doctor
ENTRYPOINT ["splatvk"]
