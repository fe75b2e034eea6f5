# gsx on CPU: docker build -t gsx . && docker run --rm -v "$PWD:/data" -w /data gsx scene=demo
# Files that are yours, and compiled code that is kept: --user "$(id -u):$(id -g)" -e GSX_CACHE=/data/.gsx_cache
# On an NVIDIA GPU: --build-arg TORCH_INDEX=https://pypi.org/simple, and `docker run --gpus all`.
FROM python:3.11-slim
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
# the compiled rasterizer wants a C++ compiler
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
WORKDIR /gsx
COPY constraints.txt pyproject.toml README.md LICENSE ./
COPY src src
COPY conf conf
RUN pip install --no-cache-dir --constraint constraints.txt --extra-index-url "$TORCH_INDEX" ".[viewer,video,sog]"
ENTRYPOINT ["gsx"]
