// The bundle of vendor/three.min.js, for the check of types.
declare const Three: any;
