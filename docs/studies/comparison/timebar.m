function k = timebar(varargin)
% Number of the step, as the PSINS function of this name returns it, without its window.
  persistent step
  if nargin > 0, step = 1; else, step = step + 1; end
  k = step;
end
