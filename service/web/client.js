import{a,b}from"./chunk-Y5OS2IJ7.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
