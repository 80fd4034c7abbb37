FROM python:3.12-slim
COPY . /src
RUN pip install --no-cache-dir /src && sfm-shapefit warm-up
WORKDIR /data
ENTRYPOINT ["sfm-shapefit"]
