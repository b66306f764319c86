% A Kalman filter on the fixes alone, in Octave: octave-cli -q solve.m LOGS OUT, see docs/howto/external.md.
%
% Position and velocity of each axis, driven by white acceleration (Bar-Shalom, Estimation with Applications, section 6.2.2),
% corrected by the position and the velocity of each fix: what a receiver gives without an IMU. SI units; angles in degrees.
1;

function run_one(folder, path)
  % The drive stands for an acceleration of 3 m/s^2 (an aircraft banked by 17 degrees) that lasts a second: 2 * 3^2 * 1 s.
  drive = 18;
  start = table([folder "/initial.csv"]);
  gnss = table([folder "/gnss.csv"]);
  t = table([folder "/imu.csv"]).time_s;
  spec = jsondecode(fileread([folder "/log.json"])).gnss;
  n = numel(gnss.time_s);
  fix_t = gnss.time_s - spec.latency_s;

  [per_lat, per_lon] = metres_per_degree(start.lat_deg, start.alt_m);
  east = mod(gnss.lon_deg - start.lon_deg + 180, 360) - 180;
  place = [per_lat * (gnss.lat_deg - start.lat_deg), per_lon * east, start.alt_m - gnss.alt_m];
  % metres are those of the start: far from it, those of a velocity are longer or shorter
  [here_lat, here_lon] = metres_per_degree(gnss.lat_deg, gnss.alt_m);
  longer = [ones(1, 3); here_lat / per_lat, here_lon / per_lon, ones(n, 1)];
  speed = [gnss.v_north_mps, gnss.v_east_mps, gnss.v_down_mps] ./ longer(2:end, :);
  [r_place, r_speed] = variances(gnss, spec, n);

  % One row for the start and one for each fix: time, position and velocity of the three axes, and their covariances.
  x = zeros(n + 1, 3); v = zeros(n + 1, 3);
  p = zeros(n + 1, 3, 3);  % of position; of position and velocity; of velocity
  v(1, :) = [start.v_north_mps, start.v_east_mps, start.v_down_mps];
  p(1, :, 1) = [start.std_position_north_m, start.std_position_east_m, start.std_position_down_m] .^ 2;
  p(1, :, 3) = [start.std_velocity_north_mps, start.std_velocity_east_mps, start.std_velocity_down_mps] .^ 2;
  at = [start.time_s; fix_t];
  for k = 1:n
    dt = max(0, at(k + 1) - at(k));
    [a, b, c] = carried(squeeze(p(k, :, 1)), squeeze(p(k, :, 2)), squeeze(p(k, :, 3)), dt, drive);
    xk = x(k, :) + v(k, :) * dt; vk = v(k, :);
    % position, then velocity: two scalar updates of each axis
    gain_x = a ./ (a + r_place(k, :)); gain_v = b ./ (a + r_place(k, :));
    off = place(k, :) - xk;
    xk += gain_x .* off; vk += gain_v .* off;
    c -= gain_v .* b; b -= gain_v .* a; a -= gain_x .* a;
    gain_x = b ./ (c + r_speed(k, :)); gain_v = c ./ (c + r_speed(k, :));
    off = speed(k, :) - vk;
    x(k + 1, :) = xk + gain_x .* off; v(k + 1, :) = vk + gain_v .* off;
    a -= gain_x .* b; b -= gain_v .* b; c -= gain_v .* c;
    p(k + 1, :, 1) = a; p(k + 1, :, 2) = b; p(k + 1, :, 3) = c;
  end

  row = max(1, lookup(at, t + 1e-7));  % the latest fix at each IMU sample
  dt = max(0, t - at(row));
  [a, ~, c] = carried(p(row, :, 1), p(row, :, 2), p(row, :, 3), dt, drive);
  place = x(row, :) + v(row, :) .* dt;
  lon = mod(start.lon_deg + place(:, 2) / per_lon + 180, 360) - 180;
  answer = [t, start.lat_deg + place(:, 1) / per_lat, lon, start.alt_m - place(:, 3), v(row, :) .* longer(row, :), sqrt(a), sqrt(c)];
  file = fopen(path, "w");
  fputs(file, ["time_s,lat_deg,lon_deg,alt_m,v_north_mps,v_east_mps,v_down_mps," ...
    "std_position_north_m,std_position_east_m,std_position_down_m," ...
    "std_velocity_north_mps,std_velocity_east_mps,std_velocity_down_mps\n"]);
  fprintf(file, ["%.9f,%.10f,%.10f,%.6f" repmat(",%.6f", 1, 9) "\n"], answer');
  fclose(file);
end

% Variances of position, of position with velocity, and of velocity after dt seconds of white acceleration.
function [a, b, c] = carried(a, b, c, dt, drive)
  a += 2 * dt .* b + dt .^ 2 .* c + drive * dt .^ 3 / 3;
  b += dt .* c + drive * dt .^ 2 / 2;
  c += drive * dt;
end

% What the receiver states of each fix, else its specification: white and slow error together.
function [r_place, r_speed] = variances(gnss, spec, n)
  level = spec.horizontal_sigma ^ 2 + spec.horizontal_markov_sigma ^ 2;
  up = spec.vertical_sigma ^ 2 + spec.vertical_markov_sigma ^ 2;
  r_place = repmat([level, level, up], n, 1);
  r_speed = repmat(spec.velocity_sigma ^ 2, n, 3);
  axes = {"north", "east", "down"};
  for k = 1:3
    if isfield(gnss, ["std_" axes{k} "_m"]) r_place(:, k) = gnss.(["std_" axes{k} "_m"]) .^ 2; end
    if isfield(gnss, ["std_v_" axes{k} "_mps"]) r_speed(:, k) = gnss.(["std_v_" axes{k} "_mps"]) .^ 2; end
  end
  r_place = max(r_place, 1e-6);
  r_speed = max(r_speed, 1e-8);
end

% WGS-84: radii of curvature along the meridian and across it.
function [per_lat, per_lon] = metres_per_degree(lat, h)
  e2 = 0.00669437999014; w = 1 - e2 * sind(lat) .^ 2;
  per_lat = pi / 180 * (6378137 * (1 - e2) ./ w .^ 1.5 + h);
  per_lon = pi / 180 * (6378137 ./ sqrt(w) + h) .* cosd(lat);
end

% Columns of a CSV file as fields.
function found = table(path)
  file = fopen(path);
  names = strsplit(strtrim(fgetl(file)), ",");
  fclose(file);
  rows = dlmread(path, ",", 1, 0);
  for k = 1:numel(names)
    found.(names{k}) = rows(:, k);
  end
end

[logs, out] = argv(){1:2};
for run = dir(logs)'
  if run.isdir && all(isdigit(run.name))
    run_one([logs "/" run.name], [out "/" run.name ".csv"]);
  end
end
