% `my-filter`: the last fix, carried on at its velocity. A filter in Octave: the folder of one run in, its answer out. To change.
%
%   octave-cli -q my-filter.m LOGS/000000 > LOGS/answers/my-filter/000000.csv
folder = argv(){1};
radius = 6.37e6;  % of the Earth, m

% time_s, lat_deg, lon_deg, alt_m, v_north_mps, v_east_mps, v_down_mps: the start and then the fixes
start = dlmread([folder "/initial.csv"], ",", 1, 0);
fixes = [start(1, 1:7); dlmread([folder "/gnss.csv"], ",", 1, 0)(:, 1:7)];
t = dlmread([folder "/imu.csv"], ",", 1, 0)(:, 1);

last = fixes(lookup(fixes(:, 1), t), :);  % the latest row at each time
age = t - last(:, 1);
lat = last(:, 2) + rad2deg(last(:, 5) .* age / radius);
lon = last(:, 3) + rad2deg(last(:, 6) .* age ./ (radius * cosd(last(:, 2))));
alt = last(:, 4) - last(:, 7) .* age;

printf("time_s,lat_deg,lon_deg,alt_m,v_north_mps,v_east_mps,v_down_mps\n");
printf("%.9f,%.10f,%.10f,%.6f,%.6f,%.6f,%.6f\n", [t, lat, lon, alt, last(:, 5:7)]');
