% Align the records of a sinsjax export (format psins) with a function of the PSINS toolbox.
%
%   octave-cli psins_runs.m PSINS DIR FUNCTION SETTINGS OUT
%
% PSINS     folder of the toolbox (with psinsinit.m and base/)
% DIR       export of a study with the WGS84 Earth
% FUNCTION  alignvn, alignvn_ekf, aligni0, alignWahba or aligncmps
% SETTINGS  alignvn, alignvn_ekf: [wvn level yaw], the measurement noise and the sigmas of P0 in deg;
%           aligncmps: [level time, its end, level time, time of the compass], s
% OUT       CSV file of the results, one row per run and second
args = argv();
[psins, folder, name, settings, out] = args{:};
settings = str2num(settings);
warning('off', 'all');
addpath(psins); addpath(genpath(fullfile(psins, 'base')));
addpath(fileparts(mfilename('fullpath')));  % after PSINS, so that its window is replaced
glvs;

% initial.csv: numbers first, then the record and the digest of the study
file = fopen(fullfile(folder, 'initial.csv'));
names = strsplit(fgetl(file), ',');
rows = textscan(file, [repmat('%f', 1, numel(names) - 2) '%s%s'], 'Delimiter', ',');
fclose(file);
column = @(wanted) rows{strcmp(names, wanted)};
run_id = column('run_id'); record = column('file');
start = [column('pitch_deg') column('roll_deg') column('yaw_deg')] * pi / 180;
pos = [column('latitude_deg') * pi / 180, zeros(numel(run_id), 1), column('height_m')];
digest = column('study'){1};

sensors = imuerrset(0.1, 500, 1.6667e-4, 50);  % deg/h, ug, deg/sqrt(h), ug/sqrt(Hz)
results = fopen(out, 'w');
fprintf(results, 'run_id,time_s,pitch_deg,roll_deg,yaw_deg,study\n');
loaded = '';
for k = 1:numel(run_id)
  is_new = ~strcmp(loaded, record{k});
  if is_new
    loaded = record{k}; imu = load(fullfile(folder, loaded));
  end
  switch name
    case {'alignvn', 'alignvn_ekf'}
      p0 = settings([2; 2; 3])' * pi / 180;
      [~, att] = feval(name, imu, a2qua(start(k, :)'), pos(k, :)', p0(:), sensors, settings(1), 0);
    case 'aligncmps'
      [~, att] = aligncmps(imu, a2qua(start(k, :)'), pos(k, :)', settings(1:2), settings(3:4), 0);
    case 'aligni0'  % these two need no start, so the runs of one record are the same
      if is_new, [~, res] = aligni0(imu, pos(k, :)', 0); att = res.attk; end
    case 'alignWahba'
      if is_new, [~, att] = alignWahba(imu, pos(k, :)', 0); end
  end
  t = att(:, end);
  whole = abs(t - round(t)) < 1e-6 & all(isfinite(att(:, 1:3)), 2) & t > 0.5;
  rows = [repmat(run_id(k), nnz(whole), 1), round(t(whole)), att(whole, 1:3) * 180 / pi];
  fprintf(results, ['%d,%d,%.9f,%.9f,%.9f,' digest '\n'], rows');
end
fclose(results);
