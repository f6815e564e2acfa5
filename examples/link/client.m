% A client of `thermorender serve` for MATLAB, and for Octave with its package instrument-control.
%
%     frames = client(host, port, token_file, count)
%
% It flies straight ahead, looks down, and returns the counts, (height, width, count) uint16. The messages are those of
% docs/reference/link.md.
function frames = client(host, port, token_file, count)
  connection = tcpclient(host, port, 'Timeout', 60);
  file = fopen(token_file, 'r');
  token = fread(file, 64, 'uint8=>uint8').';
  fclose(file);
  transfer(connection, 1, 0, 1, token);

  % The scene's camera, method A, positions ENU, quaternion of the camera, seed 11, 30 frames per second.
  settings = zeros(1, 200, 'uint8');
  settings(129) = uint8('A');
  settings(137:144) = typecast(uint64(11), 'uint8');
  settings(145:152) = typecast(30, 'uint8');
  opened = transfer(connection, 3, 1, 2, settings);
  size_px = double(typecast(opened(1:8), 'uint32'));

  frames = zeros(size_px(2), size_px(1), count, 'uint16');
  for index = 1:count
    time_s = (index - 1) / 30;
    % Time, products (1: counts), flags, poses, objects, width, height, texel of a picture.
    request = [typecast(time_s, 'uint8'), typecast(uint32([1 0 1 0 0 0]), 'uint8'), typecast(0, 'uint8')];
    % Time, east, north, up, and half a turn about east: the camera looks down with north on top.
    pose = typecast([time_s, 0, 0.5 * time_s, 12, 0, 1, 0, 0], 'uint8');
    reply = transfer(connection, 5, 1, 2 + index, [request, pose]);
    pixels = typecast(reply(65:64 + 2 * prod(size_px)), 'uint16');
    frames(:, :, index) = reshape(pixels, size_px(1), size_px(2)).';
  end
  clear connection
end

% Send a message and return the payload of its answer.
function payload = transfer(connection, type, session, id, payload)
  head = [uint8('TRLK'), typecast(uint16([1, type]), 'uint8'), typecast(uint32([numel(payload), session]), 'uint8'), ...
          typecast(uint64(id), 'uint8')];
  write(connection, [head, payload]);
  head = exactly(connection, 24);
  payload = exactly(connection, double(typecast(head(9:12), 'uint32')));
  if typecast(head(7:8), 'uint16') == 9
    error('%s', native2unicode(payload(5:end), 'UTF-8'));
  end
end

% Read a number of bytes, as a row.
function data = exactly(connection, count)
  data = zeros(1, 0, 'uint8');
  while numel(data) < count
    got = read(connection, count - numel(data));
    if isempty(got)
      error('the server closed the connection, or is late');
    end
    data = [data, reshape(uint8(got), 1, [])];
  end
end
